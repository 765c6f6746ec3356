"""Trainings: by a search, and with the algorithms of Stable-Baselines3."""
