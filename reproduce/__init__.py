"""The method, the experiments and the command line."""

import importlib.metadata

__version__ = importlib.metadata.version("lunar-rescue")
