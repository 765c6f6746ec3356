"""Training of agents: by a search for policies, with Stable-Baselines3, RLlib and others."""
