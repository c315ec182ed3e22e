"""Robot shepherds moving split flocks: a fast, physics-backed 2-D simulator.

The simulated world lives here; ``shepherd_phys.envs`` holds the Gymnasium environment and
``shepherd_phys.controllers`` what moves the shepherds.
"""

from pkgutil import extend_path

from shepherd_phys._version import __version__

__all__ = ["__version__"]

# started in the checkout's root, Python finds this folder before the installed package, whose envs, controllers and
# scripts lie elsewhere: look there, too
__path__ = extend_path(__path__, __name__)
