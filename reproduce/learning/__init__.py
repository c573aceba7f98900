"""What all methods share: configuration, workers, mirrored view, actions, networks and the sequence learner."""
