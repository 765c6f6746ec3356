"""The users of a lab, and what is left of what they may do."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from datetime import datetime, timedelta

from fmugym.lab.data import UserInfo
from fmugym.lab.errors import LabError
from fmugym.lab.experiments import EXPERIMENTS
from fmugym.lab.presets import Options

__all__ = ["Account", "Bucket", "User"]


@dataclass(frozen=True)
class User:
    """What a user may do. The numbers of the real lab are not public: these are nominal.

    Attributes:
        name: The user's name.
        gym: Whether the user may reserve gyms.
        number_of_attempts: How many experiments the user may start in all.
        max_experiment_length: Longest experiment or episode, in s.
        max_bucket_size: How many experiments may be started in a row.
        refil_interval: Time until an empty bucket has one more, in s.
        max_gym_length: Longest lease of a gym, in s.
        gym_max_bucket_size: How many gyms may be reserved in a row.
        experiment_types: The types of experiments the user may start.
        valid_for: How long the token is valid after the lab's opening, in s.
    """

    name: str = "guest"
    gym: bool = True
    number_of_attempts: int = 1000
    max_experiment_length: float = 60.0
    max_bucket_size: int = 20
    refil_interval: float = 30.0
    max_gym_length: float = 3600.0
    gym_max_bucket_size: int = 20
    experiment_types: tuple[str, ...] = tuple(EXPERIMENTS)
    valid_for: float = 365 * 86400.0


class Bucket:
    """A number that each start takes one from and that time fills up again.

    Args:
        size: The number at the beginning and at the most.
        interval: Time for one more, in s.
        now: The lab's time, in s.
    """

    def __init__(self, size: int, interval: float, now: float) -> None:
        self._size, self._interval = size, interval
        self._level, self._since = size, now

    def level(self, now: float) -> int:
        """Return the number at a time in s."""
        gained = math.floor((now - self._since) / self._interval)
        if self._level + gained >= self._size:
            self._level, self._since = self._size, now
        elif gained > 0:
            self._level += gained
            self._since += gained * self._interval
        return self._level

    def check(self, now: float) -> None:
        """Refuse if it is empty.

        Raises:
            LabError: If it is.
        """
        if self.level(now) < 1:
            raise too_many_requests(self._since + self._interval - now)

    def take(self, now: float) -> None:
        """Take one."""
        self._level = self.level(now) - 1


class Account:
    """What is left of a user's rights.

    Args:
        user: The rights.
        options: Tell how many starts there may be in a while.
        now: The lab's time, in s.
        date: The date at that time.
    """

    def __init__(self, user: User, options: Options, now: float, date: datetime) -> None:
        self.user = user
        self._options, self._opened, self._date = options, now, date
        self._attempts = user.number_of_attempts
        self._bucket = Bucket(user.max_bucket_size, user.refil_interval, now)
        self._gym_bucket = Bucket(user.gym_max_bucket_size, user.refil_interval, now)
        self._starts: deque[float] = deque()

    def info(self, now: float) -> UserInfo:
        """Return what is left at a time in s."""
        user = self.user
        return UserInfo(
            user_name=user.name,
            number_of_attempts=self._attempts,
            max_experiment_length=user.max_experiment_length,
            bucket_size=self._bucket.level(now),
            max_bucket_size=user.max_bucket_size,
            refil_interval=user.refil_interval,
            valid_from=self._date,
            valid_until=self._date + timedelta(seconds=user.valid_for),
            experiment_types=user.experiment_types,
            max_gym_length=user.max_gym_length if user.gym else 0.0,
            gym_bucket_size=self._gym_bucket.level(now) if user.gym else 0,
            gym_max_bucket_size=user.gym_max_bucket_size if user.gym else 0,
        )

    def check_valid(self, now: float) -> None:
        """Refuse a user whose time is over.

        Raises:
            LabError: If it is.
        """
        if now - self._opened > self.user.valid_for:
            raise LabError(f"the token of user {self.user.name!r} has expired")

    def take_experiment(self, now: float) -> None:
        """Take an attempt, from the bucket too.

        Raises:
            LabError: If none is left, or too many were taken in a while.
        """
        if self._attempts < 1:
            raise LabError(f"user {self.user.name!r} has no attempts left")
        self._bucket.check(now)
        self.take_start(now)
        self._bucket.take(now)
        self._attempts -= 1

    def take_gym(self, now: float) -> None:
        """Take a gym from its bucket.

        Raises:
            LabError: If the user may not, or too many were taken in a while.
        """
        if not self.user.gym:
            raise LabError(f"the token of user {self.user.name!r} has no gym permission")
        self._gym_bucket.check(now)
        self.take_start(now)
        self._gym_bucket.take(now)

    def take_start(self, now: float) -> None:
        """Count a start of any kind.

        Raises:
            LabError: If there were too many in a while.
        """
        limit, window = self._options.starts_per_window, self._options.start_window
        while self._starts and self._starts[0] <= now - window:
            self._starts.popleft()
        if limit is None:
            return
        if len(self._starts) >= limit:
            raise too_many_requests(self._starts[0] + window - now if self._starts else window)
        self._starts.append(now)


def too_many_requests(wait: float) -> LabError:
    """Make the error for a start that comes too early by a time in s."""
    return LabError(f"Too many requests, try again in {max(1, math.ceil(wait))} seconds")
