"""Robot shepherds moving split flocks: a fast, physics-backed 2-D simulator.

The simulated world lives here; ``shepherd_phys.envs`` holds the Gymnasium environment and
``shepherd_phys.controllers`` what moves the shepherds.
"""

from shepherd_phys._version import __version__

__all__ = ["__version__"]
