"""Trainings with the algorithms of Stable-Baselines3."""
