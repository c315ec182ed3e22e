"""Learning shepherd policies with stable-baselines3: the one room for torch."""
