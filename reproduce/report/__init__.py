"""The report: a static site from the executed notebooks and results/, which opens from file:// and asks no network."""
