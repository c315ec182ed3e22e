"""`Cluster`: the workers of a Dask cluster, doing jobs one by one as `Workers` do.

A job is sent to one Dask worker by name and to no other, so that it is known where every job is. What becomes of a job
whose worker dies is then decided here, not by the scheduler's rule of three further attempts on other workers.

Dask is imported only when a cluster is entered. What is sent are functions that pickle by value and import this package
where they run: the scheduler need not have it.
"""

from __future__ import annotations

import logging
import pickle
import queue
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Self

from shepherd_phys import __version__
from shepherd_phys.workers import Ended, Job, Work, WorkersError, explain

CONNECT_SECONDS = 10.0
"""A scheduler that has not answered by then is not there [s]."""
LOOK_SECONDS = 1.0
"""Workers that come and go are noticed within this time [s]."""
LOST_SECONDS = 60.0
"""A scheduler that does not answer for so long is lost, even if its machine still holds the connection [s]."""
RESTART_SECONDS = 20.0
"""For the restart of a hanging worker [s]."""
PATIENCE_SECONDS = 15.0
"""Workers that take longer to answer for the first time are worth a word [s]."""


@dataclass(eq=False)
class _Sent:
    """A job, and until when it may take."""

    job: Job
    pickled: bytes
    future: Any = None
    deadline: float = float("inf")


@dataclass(eq=False)
class _Site:
    """A Dask worker, and what it is doing: never more than it has threads.

    No job waits there for another's end: a worker that dies takes with it what it had finished and not yet handed over,
    so a job that is begun the moment another ends, and kills its worker, would cost that other too.
    """

    address: str
    threads: int
    late: bool
    """Whether it came after the campaign had begun."""
    open: bool = True
    """Whether it takes jobs."""
    ready: bool = False
    """Whether it has shown that it can do them."""
    unfit: bool = False
    """Whether it has shown that it cannot."""
    sent: list[_Sent] = field(default_factory=list)
    greeting: Any = None

    @property
    def room(self) -> float:
        """Jobs that it can still take, by thread."""
        return (self.threads - len(self.sent)) / self.threads if self.ready and self.open else 0.0


class Cluster:
    """The workers of a Dask cluster doing ``work``, those that join later too. A context manager.

    A job whose worker dies has failed. A job that takes too long has failed too: its worker is restarted, where a nanny
    watches it, or ended; what else it was doing of ours is given to another and has lost nothing. (Other users' jobs on
    that worker are restarted with it.) Otherwise the scheduler is told nothing that concerns others.

    Args:
        work: the function; workers import it.
        timeout: of one job [s].
        address: of the scheduler.
        say: is told, in a line, what the user should know.
    """

    def __init__(self, work: Work, timeout: float, *, address: str, say: Callable[[str], None]) -> None:
        self._work = pickle.dumps(work)
        self._timeout = timeout
        self._address = address
        self._say = say
        self._client: Any = None
        self._sites: dict[str, _Site] = {}
        self._restarting: set[str] = set()
        self._homeless: deque[_Sent] = deque()
        self._news: queue.SimpleQueue[tuple[_Site, _Sent | None, Any]] = queue.SimpleQueue()
        self._looked = 0.0
        self._idle_since = time.monotonic()
        self._said = ""
        self._exits = ExitStack()

    def __enter__(self) -> Self:
        try:
            import distributed
        except ImportError as error:
            raise WorkersError(
                f"scheduler: needs dask.distributed ({error}): pip install 'shepherd-phys[cluster]'"
            ) from None
        with ExitStack() as exits:
            exits.enter_context(_silence())
            self._client = exits.enter_context(_connected(distributed.Client, self._address))
            self._look(late=False)
            self._exits = exits.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        # without this the jobs under way would be waited for
        self._drop(sent for site in self._sites.values() for sent in site.sent)
        self._exits.close()

    def idle(self) -> bool:
        """Whether a worker has room for a job."""
        return not self._homeless and any(site.room > 0 for site in self._sites.values())

    def give(self, job: Job) -> None:
        """Hand a job to the worker with the most room."""
        self._send(_Sent(job, pickle.dumps((job.spec, job.seed))))

    def wait(self) -> list[Ended]:
        """Sleep until something happens, but not for long; the jobs that ended meanwhile.

        Raises:
            WorkersError: the scheduler is lost, or a worker cannot do the work.
        """
        news = self._arrived()
        if self._client.status != "running":
            raise self._lost()
        ended = [end for site, sent, result in news for end in self._attend(site, sent, result)]
        if time.monotonic() - self._looked >= LOOK_SECONDS:
            ended += self._look(late=True)
        ended += self._end_overdue()
        while self._homeless and any(site.room > 0 for site in self._sites.values()):
            self._send(self._homeless.popleft())
        self._comment()
        return ended

    def _arrived(self) -> list[tuple[_Site, _Sent | None, Any]]:
        """What has come in; sleeps until there is something or it is time to look round."""
        due = min([self._looked + LOOK_SECONDS, *(s.deadline for site in self._sites.values() for s in site.sent)])
        news = []
        with suppress(queue.Empty):
            news.append(self._news.get(timeout=max(0.0, due - time.monotonic())))
            while True:
                news.append(self._news.get_nowait())
        return news

    def _attend(self, site: _Site, sent: _Sent | None, result: Any) -> Iterator[Ended]:
        """An answer to a greeting, or to a job."""
        if getattr(result, "reason", "") == "scheduler-connection-lost":
            raise self._lost()
        if sent is None:
            if self._sites.get(site.address) is site:
                self._admit(site, result)
        elif sent not in site.sent:
            return  # it was given up already
        elif type(result).__name__ == "KilledWorker":  # a scheduler may be told to give up at the first death
            yield from self._bury(site)
        else:
            site.sent.remove(sent)
            if isinstance(result, BaseException):
                yield Ended(sent.job.key, None, f"lost by the cluster: {explain(result)}")
            else:
                ok, text = result
                yield Ended(sent.job.key, text, "") if ok else Ended(sent.job.key, None, text)

    def _admit(self, site: _Site, answer: Any) -> None:
        """Take a worker into service by its answer to the greeting.

        Raises:
            WorkersError: it was there from the beginning and cannot do the work. One that joins later only stays idle.
        """
        version, problem = ("", explain(answer)) if isinstance(answer, BaseException) else answer
        if version and version != __version__:
            problem = f"it has shepherd_phys {version}, this is {__version__}"
        if not problem:
            site.ready = True
            return
        site.unfit = True
        text = f"scheduler: worker {site.address} of {self._address} cannot do the work: {problem}"
        if not site.late:
            raise WorkersError(f"{text}; every worker needs shepherd_phys {__version__} and your own modules")
        self._say(f"{text}; it is not used")

    def _look(self, late: bool) -> list[Ended]:
        """Notice workers that came and went; the jobs that went with them."""
        try:
            seen = self._client.sync(self._client.scheduler.identity, n_workers=-1, callback_timeout=LOST_SECONDS)
        except Exception:
            raise self._lost() from None
        self._looked = time.monotonic()
        gone = [site for address, site in self._sites.items() if address not in seen["workers"]]
        ended = [end for site in gone for end in self._bury(site)]
        for address, worker in seen["workers"].items():
            if address in self._restarting:
                continue
            if address not in self._sites:
                site = self._sites[address] = _Site(address, max(1, worker["nthreads"]), late)
                site.greeting = self._submit(site, None, _greeting(), self._work)
            self._sites[address].open = worker["status"] == "running"
        return ended

    def _bury(self, site: _Site) -> list[Ended]:
        """A worker has died: the jobs that it was doing."""
        del self._sites[site.address]
        lost = site.sent
        self._leave(site, [])
        return [Ended(sent.job.key, None, f"worker died ({site.address})") for sent in lost]

    def _end_overdue(self) -> list[Ended]:
        """Give up jobs that hang, and restart their workers."""
        now = time.monotonic()
        hanging = [site for site in self._sites.values() if any(sent.deadline <= now for sent in site.sent)]
        ended = []
        for site in hanging:
            del self._sites[site.address]
            ended += [
                Ended(sent.job.key, None, f"hung: no end after {self._timeout:g} s")
                for sent in site.sent
                if sent.deadline <= now
            ]
            self._leave(site, [sent for sent in site.sent if sent.deadline > now])
        if hanging:
            self._restart({site.address for site in hanging})
        return ended

    def _restart(self, addresses: set[str]) -> None:
        """Have workers' processes ended, and begun anew where a nanny does that; it takes seconds."""
        self._restarting |= addresses

        def restart() -> None:
            with suppress(Exception):  # then they are greeted again, and answer when they can
                self._client.restart_workers(list(addresses), RESTART_SECONDS, raise_for_error=False)
            self._restarting -= addresses

        threading.Thread(target=restart, daemon=True).start()

    def _leave(self, site: _Site, innocent: list[_Sent]) -> None:
        """Give up a worker; jobs that lost nothing by it look for another."""
        self._drop(site.sent)
        site.sent = []
        self._homeless += innocent

    def _send(self, sent: _Sent) -> None:
        site = max(self._sites.values(), key=lambda site: site.room)
        site.sent.append(sent)
        sent.deadline = time.monotonic() + self._timeout
        sent.future = self._submit(site, sent, _doing(), self._work, sent.pickled)

    def _submit(self, site: _Site, sent: _Sent | None, function: Any, *arguments: bytes) -> Any:
        """Have a worker, and no other, do something; what comes of it arrives as news."""
        future = self._client.submit(
            function,
            *arguments,
            workers=[site.address],
            allow_other_workers=False,
            pure=False,
            retries=0,
            fifo_timeout=0,
        )
        future.add_done_callback(partial(self._done, site, sent))
        return future

    def _done(self, site: _Site, sent: _Sent | None, future: Any) -> None:
        # Dask has one thread for all callbacks, and what a worker did that has died since may be looked for half a
        # minute: nobody else should wait for that
        threading.Thread(target=self._fetch, args=(site, sent, future), daemon=True).start()

    def _fetch(self, site: _Site, sent: _Sent | None, future: Any) -> None:
        try:
            result = future.result()
        except BaseException as error:
            result = error
        self._news.put((site, sent, result))

    def _drop(self, given_up: Any) -> None:
        futures = [sent.future for sent in given_up if sent.future is not None]
        if futures:
            with suppress(Exception):
                self._client.cancel(futures)

    def _comment(self) -> None:
        """Say once why nothing goes on."""
        now = time.monotonic()
        if any(site.ready for site in self._sites.values()):
            self._idle_since, self._said = now, ""
            return
        text = ""
        if all(site.unfit for site in self._sites.values()):
            able = " that can do the work" if self._sites else ""
            text = f"scheduler {self._address} has no workers{able}; waiting for one to join"
        elif now - self._idle_since > PATIENCE_SECONDS:
            text = f"none of the workers of {self._address} has answered yet; waiting"
        if text and text != self._said:
            self._say(text)
            self._said = text

    def _lost(self) -> WorkersError:
        return WorkersError(
            f"scheduler: the connection to {self._address} is lost; what was finished is kept: "
            "the same command continues"
        )


def _connected(make_client: Callable[..., Any], address: str) -> Any:
    """A client of the scheduler.

    It is made in a thread, because Dask's own timeout does not hold with somebody who listens and says nothing.

    Raises:
        WorkersError: there is no scheduler.
    """
    answers: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def connect() -> None:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of versions that differ somewhere: greetings see to ours
                answers.put(make_client(address, timeout=CONNECT_SECONDS, set_as_default=False))
        except BaseException as error:
            answers.put(error)

    threading.Thread(target=connect, daemon=True).start()
    try:
        answer = answers.get(timeout=CONNECT_SECONDS + 1.0)
    except queue.Empty:
        answer = TimeoutError(f"no answer in {CONNECT_SECONDS:g} s")
    if isinstance(answer, BaseException):
        problem = " ".join(str(answer).split()) or type(answer).__name__
        raise WorkersError(f"scheduler: {address} cannot be reached ({problem})")
    return answer


def _greeting() -> Callable[[bytes], tuple[str, str]]:
    def greet(work: bytes) -> tuple[str, str]:
        """The worker's version of this package, and why it cannot do the work, if it cannot."""
        try:
            import shepherd_phys
        except ImportError as error:
            return "", f"shepherd_phys is missing ({error})"
        try:
            version = shepherd_phys.__version__
            import pickle

            pickle.loads(work)
        except Exception as error:
            return version, f"{type(error).__name__}: {error}"
        return version, ""

    return greet  # a function within a function pickles by value


def _doing() -> Callable[[bytes, bytes], tuple[bool, str]]:
    def do(work: bytes, job: bytes) -> tuple[bool, str]:
        import pickle

        from shepherd_phys.workers import attempt

        return attempt(pickle.loads(work), job)

    return do


@contextmanager
def _silence() -> Iterator[None]:
    """No word from Dask meanwhile: what matters of it becomes one error or one message."""
    names = [name for name in logging.root.manager.loggerDict if name.split(".")[0] in ("distributed", "tornado")]
    before = {name: logging.getLogger(name).disabled for name in names}
    for name in names:
        logging.getLogger(name).disabled = True
    try:
        yield
    finally:
        for name, disabled in before.items():
            logging.getLogger(name).disabled = disabled
