"""The method, the experiments and the command line."""
