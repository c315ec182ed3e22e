"""pymunk's batches of bodies, and a control step's engine steps in one compiled call.

All that leans on pymunk's private names is here; where one of them is gone, `Engine.drive` uses the public functions.
"""

from __future__ import annotations

import weakref
from typing import Any, NamedTuple

import numpy as np
import pymunk
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray
from pymunk import batch

from shepherd_phys._motion import servo

Floats = NDArray[np.float64]

_LINEAR = batch.BodyFields.POSITION | batch.BodyFields.VELOCITY
_POSES = _LINEAR | batch.BodyFields.ANGLE | batch.BodyFields.ANGULAR_VELOCITY

_SPARE_BUFFERS: list[tuple[batch.Buffer, batch.Buffer]] = []
"""pymunk never frees a batch buffer: a world uses its two for every Space, and leaves them here for another world."""


class _Calls(NamedTuple):
    """What the compiled loop needs to call Chipmunk on one Space."""

    addresses: NDArray[np.intp]
    """step, each body, Space, function that writes, what it writes, function that reads, where to."""
    written: NDArray[np.int32]
    """(1,) where the next write stands in ``force``."""
    read: NDArray[np.int32]
    """(1,) numbers in ``rows``."""
    alive: tuple[Any, ...]
    """What the addresses point at."""


class Engine:
    """A Space whose bodies are read into an array and moved by forces from another.

    Attributes:
        rows: (rows, 4) x, y, vx, vy or, where bodies spin, (rows, 6) x, y, angle, vx, vy, spin, of the latest read;
            bodies in the order in which they were added, then the static one.
        force: (rows, 2) or (rows, 3) force [N] and torque [N m] of the next engine step.
    """

    rows: Floats
    force: Floats

    def __init__(self) -> None:
        buffers = _SPARE_BUFFERS.pop() if _SPARE_BUFFERS else (batch.Buffer(), batch.Buffer())
        self._read_buffer, self._write_buffer = buffers
        weakref.finalize(self, _SPARE_BUFFERS.append, buffers)

    def bind(self, space: pymunk.Space, n_bodies: int, spins: bool) -> None:
        """Take a Space with all its bodies and collision handlers, and read it."""
        self._space, self._spins = space, spins
        # the static body is the last row of every batch once anybody has touched it: do, so that it always is
        n_rows = n_bodies + len([space.static_body])
        self.force = np.zeros((n_rows, 3 if spins else 2))
        self._write_buffer.set_float_buf(self.force)
        self._fields = _POSES if spins else _LINEAR
        self._force_fields = batch.BodyFields.FORCE | batch.BodyFields.TORQUE if spins else batch.BodyFields.FORCE
        # the first read makes pymunk's memory as large as it needs to be; from then on it stays where it is
        self._read_buffer.clear()
        batch.get_space_bodies(space, self._fields, self._read_buffer)
        self.rows = np.frombuffer(self._read_buffer.float_buf()).reshape(n_rows, 6 if spins else 4)
        try:
            self._n_handlers = len(space._handlers)
            self._is_plain()
            self._calls: _Calls | None = self._bound()
        except (AttributeError, ImportError):
            self._calls = None

    def read(self) -> Floats:
        """One batch read into ``rows``."""
        self._read_buffer.clear()
        batch.get_space_bodies(self._space, self._fields, self._read_buffer)
        if len(self._read_buffer.float_buf()) != self.rows.nbytes:  # then pymunk's memory may have moved, too
            raise RuntimeError(_CROWD)
        return self.rows

    def step(self, h: float) -> None:
        """Let ``force`` act for an engine step of ``h`` seconds."""
        batch.set_space_bodies(self._space, self._force_fields, self._write_buffer)
        self._space.step(h)

    def drive(
        self,
        command: Floats,
        mass: Floats,
        moment: Floats,
        h: float,
        substeps: int,
        limit: float,
        spin_limit: float,
    ) -> Floats:
        """Drive the bodies to their commands by the servo for so many engine steps, and read them.

        Args:
            command: (N + P, 3) wanted velocity [m/s] and spin [rad/s].
            mass: (N + P,) [kg].
            moment: (N + P,) [kg m2].
            h: length of an engine step [s].
            substeps: how many.
            limit: greatest acceleration [m/s2].
            spin_limit: [rad/s2].

        Raises:
            RuntimeError: the Space holds other bodies than it did when it was bound.
        """
        calls, space = self._calls, self._space
        if calls is None or not self._is_plain():
            for _ in range(substeps):
                servo(self.rows, command, mass, moment, h, limit, spin_limit, self._spins, self.force)
                self.step(h)
                self.read()
            return self.rows
        space._locked = True  # as `Space.step` has it: what a callback adds has to wait
        try:
            whole = _drive(
                calls.addresses, calls.written, calls.read, self.rows, command, mass, moment, h, substeps,
                limit, spin_limit, self._spins, self.force,
            )  # fmt: skip
        finally:
            space._locked = False
        if not whole:
            raise RuntimeError(_CROWD)
        return self.rows

    def _is_plain(self) -> bool:
        """Whether `Space.step` would do nothing but let Chipmunk step, and no foreign callback runs meanwhile."""
        space = self._space
        return not (
            space.threaded
            or space._bodies_to_check
            or space._add_later
            or space._remove_later
            or space._removed_shapes
            or space._post_step_callbacks
            or space._constraints
            or len(space._handlers) != self._n_handlers
            or "step" in vars(space)  # somebody put his own in its place, such as a stopwatch
        )

    def _bound(self) -> _Calls:
        from pymunk._chipmunk_cffi import ffi, lib

        def batched(fields: batch.BodyFields, buffer: batch.Buffer) -> tuple[Any, NDArray[np.int32]]:
            data = ffi.new("pmBatchedData *")
            data.fields, data.floatArray, data.intArray = fields.value, buffer._float_arr, buffer._int_arr
            return data, np.frombuffer(ffi.buffer(ffi.addressof(buffer._float_arr, "num")), np.int32)

        data_out, written = batched(self._force_fields, self._write_buffer)
        data_in, read = batched(self._fields, self._read_buffer)
        pointers = (
            ffi.addressof(lib, "cpSpaceStep"),
            ffi.addressof(lib, "cpSpaceEachBody"),
            self._space._space,
            ffi.addressof(lib, "pmSpaceBodySetIteratorFuncBatched"),
            data_out,
            ffi.addressof(lib, "pmSpaceBodyGetIteratorFuncBatched"),
            data_in,
        )
        addresses = np.array([int(ffi.cast("intptr_t", pointer)) for pointer in pointers], np.intp)
        return _Calls(addresses, written, read, pointers)


_CROWD = "bodies were added to the world's space, or removed: it holds the scenario's alone"


_compiled_call: Any = intrinsic
"""As it is, but for its type: that counts the typing context among the arguments of a call."""


def _call(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Code that calls a C function without a result: its address comes first, then its arguments."""
    address, *rest = arguments
    function = ir.FunctionType(ir.VoidType(), [argument.type for argument in rest])
    builder.call(builder.inttoptr(address, function.as_pointer()), rest)
    return context.get_dummy_value()


@_compiled_call
def _step(typing: Any, step: Any, space: Any, dt: Any) -> Any:
    """``cpSpaceStep(space, dt)``, its address first."""
    return types.void(types.intp, types.intp, types.float64), _call


@_compiled_call
def _each_body(typing: Any, each: Any, space: Any, function: Any, data: Any) -> Any:
    """``cpSpaceEachBody(space, function, data)``, its address first."""
    return types.void(types.intp, types.intp, types.intp, types.intp), _call


# The GIL stays held (no nogil): Chipmunk calls back into Python where shepherds collide.
@njit(cache=True)
def _drive(  # type: ignore[no-untyped-def]
    addresses, written, read, rows, command, mass, moment, h, substeps, limit, spin_limit, spins, force
):  # fmt: skip
    """Servo, write, step and read so often; whether the bodies are as many as they were."""
    step, each, space = addresses[0], addresses[1], addresses[2]
    set_body, data_out, get_body, data_in = addresses[3], addresses[4], addresses[5], addresses[6]
    for _ in range(substeps):
        if read[0] != rows.size:  # pymunk's memory may have moved
            return False
        servo(rows, command, mass, moment, h, limit, spin_limit, spins, force)
        written[0] = 0
        _each_body(each, space, set_body, data_out)
        _step(step, space, h)
        read[0] = 0
        _each_body(each, space, get_body, data_in)
    return read[0] == rows.size
