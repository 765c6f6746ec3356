"""The users of a lab, and how much of their rights is left."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import UTC, datetime, timedelta
from typing import Any

from fmugym.checks import (
    check_flag,
    check_integer,
    check_mapping,
    check_number,
    check_option,
    check_text,
)
from fmugym.errors import ConfigError, shown
from fmugym.lab.data import LabError, UserInfo
from fmugym.lab.experiments import EXPERIMENTS
from fmugym.lab.presets import Options

__all__ = ["Account", "Accounts", "Bucket", "User"]


@dataclass(frozen=True)
class User:
    """A user's rights. The numbers of the real lab are not public; these are nominal.

    Attributes:
        name: The user's name.
        gym: Whether the user may reserve gyms.
        number_of_attempts: How many experiments the user may start in all.
        max_experiment_length: Longest experiment or episode, in s.
        max_bucket_size: How many experiments the user may start in a row.
        refil_interval: Time after which an empty bucket has one start again, in s.
        max_gym_length: Longest lease of a gym, in s.
        gym_max_bucket_size: How many gyms the user may reserve in a row.
        experiment_types: The types of experiments the user may start.
        valid_for: How long the token is valid after the lab opens, in s.

    Raises:
        ConfigError: If a value has a wrong type or is out of its range.
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

    def __post_init__(self) -> None:
        for field in fields(self):
            value = _checked(field.name, getattr(self, field.name), field.default)
            object.__setattr__(self, field.name, value)


def _checked(name: str, value: Any, default: Any) -> Any:
    what = f"{name} of a user"
    if name == "gym":
        return check_flag(what, value)
    if name == "experiment_types":
        return _known_types(value)
    if isinstance(default, int):
        return check_integer(what, value, 0, 10**9)
    if name == "refil_interval":
        return check_number(what, value, 1e-3, 1e9)
    if name == "name":
        return check_text(what, value)
    return check_number(what, value, 0.0, may_be_infinite=True)


def _known_types(value: Any) -> tuple[str, ...]:
    if not isinstance(value, tuple | list | set | frozenset):
        raise ConfigError(f"experiment_types of a user must be a list, not {shown(value)}")
    return tuple(check_option("experiment type", name, EXPERIMENTS) for name in value)


class Bucket:
    """A number of starts. Each start takes one; time adds new ones.

    Args:
        size: The initial and largest number.
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
        """Check that a start is left at a time in s.

        Raises:
            LabError: If the bucket is empty.
        """
        if self.level(now) < 1:
            raise too_many_requests(self._since + self._interval - now)

    def take(self, now: float) -> None:
        """Take one at a time in s."""
        self._level = self.level(now) - 1


class Account:
    """The rights that a user has left.

    Args:
        user: The user's rights.
        options: The limits on starts.
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
        """Return the rights that are left at a time in s."""
        user = self.user
        return UserInfo(
            user_name=user.name,
            number_of_attempts=self._attempts,
            max_experiment_length=user.max_experiment_length,
            bucket_size=self._bucket.level(now),
            max_bucket_size=user.max_bucket_size,
            refil_interval=user.refil_interval,
            valid_from=self._date,
            valid_until=_later(self._date, user.valid_for),
            experiment_types=user.experiment_types,
            max_gym_length=user.max_gym_length if user.gym else 0.0,
            gym_bucket_size=self._gym_bucket.level(now) if user.gym else 0,
            gym_max_bucket_size=user.gym_max_bucket_size if user.gym else 0,
        )

    def check_valid(self, now: float) -> None:
        """Check that the token is valid at a time in s.

        Raises:
            LabError: If it has expired.
        """
        if now - self._opened > self.user.valid_for:
            raise LabError(f"the token of user {self.user.name!r} has expired")

    def take_experiment(self, now: float) -> None:
        """Count a start of an experiment at a time in s.

        Raises:
            LabError: If no attempt is left, or the user has started too many in a short time.
        """
        if self._attempts < 1:
            raise LabError(f"user {self.user.name!r} has no attempts left")
        self._bucket.check(now)
        self.take_start(now)
        self._bucket.take(now)
        self._attempts -= 1

    def take_gym(self, now: float) -> None:
        """Count a start of a gym at a time in s.

        Raises:
            LabError: If the user has no permission, or has started too many in a short time.
        """
        if not self.user.gym:
            raise LabError(f"the token of user {self.user.name!r} has no gym permission")
        self._gym_bucket.check(now)
        self.take_start(now)
        self._gym_bucket.take(now)

    def take_start(self, now: float) -> None:
        """Count a start of any kind at a time in s.

        Raises:
            LabError: If the user has started too many in a short time.
        """
        limit, window = self._options.starts_per_window, self._options.start_window
        while self._starts and self._starts[0] <= now - window:
            self._starts.popleft()
        if limit is None:
            return
        if len(self._starts) >= limit:
            raise too_many_requests(self._starts[0] + window - now if self._starts else window)
        self._starts.append(now)


class Accounts:
    """The accounts of a lab's users.

    Args:
        users: The users by their tokens; None accepts any token with the rights of ``User()``.
        options: The limits on starts.
        now: The lab's time, in s.

    Raises:
        ConfigError: If the users are not a mapping from texts to ``User``.
    """

    def __init__(self, users: Mapping[str, User] | None, options: Options, now: float) -> None:
        self._users = None if users is None else _checked_users(users)
        self._options, self._opened, self._date = options, now, datetime.now(UTC)
        self._accounts: dict[str, Account] = {}

    def find(self, user_token: str, now: float) -> Account:
        """Return the account of a token at a time in s.

        Raises:
            LabError: If the token is unknown or has expired.
        """
        if self._users is not None and user_token not in self._users:
            raise LabError("unknown user token")
        if user_token not in self._accounts:
            user = User() if self._users is None else self._users[user_token]
            account = Account(user, self._options, self._opened, self._date)
            self._accounts[user_token] = account
        self._accounts[user_token].check_valid(now)
        return self._accounts[user_token]


def _checked_users(users: Any) -> dict[str, User]:
    found = check_mapping("users", users)
    for token, user in found.items():
        if not isinstance(user, User):
            raise ConfigError(f"users: expected a User for {shown(token)}, not {shown(user)}")
    return found


def _later(date: datetime, seconds: float) -> datetime:
    """Return the date some seconds later, or the last date that there is."""
    try:
        return date + timedelta(seconds=seconds)
    except OverflowError:
        return datetime.max.replace(tzinfo=UTC)


def too_many_requests(wait: float) -> LabError:
    """Make the error for a start that comes too early by a time in s."""
    return LabError(f"Too many requests, try again in {max(1, math.ceil(wait))} seconds")
