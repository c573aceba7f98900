"""Learners: recurrent PPO over whole sequences."""
