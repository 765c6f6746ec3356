"""An environment over an FMU with long steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gymnasium import spaces

import fmugym

__all__ = ["BusyEnv"]


class BusyEnv(fmugym.FMI2CSEnv):
    """Waits. The observation is the time in us that it has waited in this episode.

    Args:
        path: The FMU.
        mean: Mean time of a step in us.
        sigma: Standard deviation of the logarithm of this time; 0 for a constant time.
        rare: The probability of a step of another time.
        rare_time: This time in us.
    """

    vectorized = True

    def __init__(
        self, path: Path, mean: float, sigma: float = 0.0, rare: float = 0.0, rare_time: float = 0.0
    ) -> None:
        seed = fmugym.Uniform(0.0, 1.0)
        config = {
            "model_input_names": "u",
            "model_output_names": "busy",
            "model_parameters": {
                "mean": mean,
                "sigma": sigma,
                "seed": seed,
                "rare": rare,
                "rare_time": rare_time,
            },
            "time_step": 1.0,
        }
        super().__init__(path, config)

    def _get_action_space(self) -> spaces.Space[Any]:
        return spaces.Discrete(2)

    def _is_done(self) -> Any:
        return self.state[0] < 0.0
