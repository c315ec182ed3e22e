"""`Window`: shows canvases on a display and hands over what its user does. Needs pygame-ce, imported when one opens."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Any

from shepherd_phys.canvas import Canvas, Size, pygame_ce

BLIND = ("offscreen", "evdev")
"""Drivers that SDL takes for want of a display, and that nobody asked for then."""


class DisplayError(RuntimeError):
    """There is no display for a window; says what to do instead."""


class Window:
    """A window of ``size`` pixels; its user may change that.

    Args:
        size: (w, h) [px].
        title: what stands above it.

    Raises:
        DisplayError: there is no display.
        ImportError: pygame-ce is missing; says how to install it.
    """

    def __init__(self, size: Size, title: str) -> None:
        pygame = pygame_ce()
        asked = os.environ.get("SDL_VIDEODRIVER") or os.environ.get("SDL_VIDEO_DRIVER")
        displays = [name for name in ("DISPLAY", "WAYLAND_DISPLAY") if os.environ.get(name)]
        if sys.platform.startswith("linux") and not asked and not displays:
            raise DisplayError(_advice("neither DISPLAY nor WAYLAND_DISPLAY is set"))
        try:
            pygame.display.init()
            if not asked and pygame.display.get_driver() in BLIND:
                raise DisplayError(_advice(f"SDL found no more than its driver {pygame.display.get_driver()!r}"))
            self._screen = pygame.display.set_mode(size, pygame.RESIZABLE)
        except pygame.error as error:
            pygame.display.quit()
            raise DisplayError(_advice(str(error))) from None
        except DisplayError:
            pygame.display.quit()
            raise
        pygame.display.set_caption(title)
        self._clock = pygame.time.Clock()

    @property
    def size(self) -> Size:
        """(w, h) as it is now [px]."""
        w, h = self._screen.get_size()
        return int(w), int(h)

    def show(self, canvas: Canvas) -> None:
        """Show a picture."""
        if self._screen is not pygame_ce().display.get_surface():  # its user has made it larger or smaller
            self._screen = pygame_ce().display.get_surface()
        self._screen.blit(canvas.surface, (0, 0))
        pygame_ce().display.flip()

    def events(self) -> Sequence[Any]:
        """What its user has done since the last call: pygame's events."""
        return list(pygame_ce().event.get())

    def asks_to_close(self, event: Any) -> bool:
        """Whether an event is its user's wish to close it."""
        return bool(event.type == pygame_ce().QUIT)

    def wait(self, fps: float) -> float:
        """Wait until the next of ``fps`` pictures a second is due; the seconds since the last one."""
        return float(self._clock.tick(fps)) / 1000.0

    def close(self) -> None:
        """Close it."""
        pygame_ce().display.quit()


def _advice(reason: str) -> str:
    return (
        f"no display for a window ({reason}): set DISPLAY, or SDL_VIDEODRIVER to a driver that works; "
        "without one, pictures (render_mode 'rgb_array') and films (watch --out FILE.mp4) need none"
    )
