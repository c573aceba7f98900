"""Section 4: the registry of methods, training, evaluation, tuning and the batch."""
