"""What lies under all: files, errors, provenance, policies and checkpoints."""
