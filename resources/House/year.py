"""Makes the synthetic year of the house: `python resources/House/year.py`.

The year is invented, but it has what makes control interesting: cold spells of several days, clouds
that last, people who come home, and prices that follow the clock, the sun and the wind. It has 365
days from Monday, 1 January, in local solar time at 52 degrees north. Every value is the mean of the
hour that begins at its time. README.md says where the formulas come from. The same seed gives the
same file.
"""

from __future__ import annotations

import csv
import math
import random
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).resolve().parent
FILE = HERE.parents[1] / "fmugym" / "envs" / "house_year.csv"
COLUMNS = ("time_s", "T_out_degC", "I_sol_W_m2", "Q_int_W", "price_EUR_kWh")

DAYS = 365
LATITUDE = math.radians(52.0)
REFLECTANCE_OF_GROUND = 0.2


class Noise:
    """A stationary process with a standard deviation of 1 that forgets with a time constant.

    Args:
        rng: Where its steps come from.
        hours: The time constant.
    """

    def __init__(self, rng: random.Random, hours: float) -> None:
        self._rng = rng
        self._kept = math.exp(-1.0 / hours)
        self._value = rng.gauss(0.0, 1.0)

    def step(self) -> float:
        """Return the value of the next hour."""
        added = math.sqrt(1.0 - self._kept**2) * self._rng.gauss(0.0, 1.0)
        self._value = self._kept * self._value + added
        return self._value


class Sun(NamedTuple):
    """Where the sun stands.

    Attributes:
        height: Sine of its elevation; negative at night.
        on_south: Cosine of the angle to a vertical wall that looks south.
    """

    height: float
    on_south: float


def sun_at(day: int, hour: float) -> Sun:
    """Return the sun's position; the declination is Cooper's (1969).

    Args:
        day: Days since 1 January.
        hour: Solar time.
    """
    declination = math.radians(23.45) * math.sin(2 * math.pi * (284 + day + 1) / 365)
    angle = math.pi * (hour - 12) / 12
    height = math.sin(LATITUDE) * math.sin(declination)
    height += math.cos(LATITUDE) * math.cos(declination) * math.cos(angle)
    on_south = math.sin(LATITUDE) * math.cos(declination) * math.cos(angle)
    on_south -= math.cos(LATITUDE) * math.sin(declination)
    return Sun(height, on_south)


def global_irradiance(height: float, cloud_cover: float) -> float:
    """Return the irradiance on the ground in W/m2.

    The clear sky is Haurwitz's (1945), the effect of clouds Kasten and Czeplak's (1980).

    Args:
        height: Sine of the sun's elevation.
        cloud_cover: From 0, a clear sky, to 1.
    """
    if height <= 0.02:  # Haurwitz's formula is for a sun well above the horizon
        return 0.0
    return 1098.0 * height * math.exp(-0.057 / height) * (1.0 - 0.75 * cloud_cover**3.4)


def diffuse_share(irradiance: float, height: float) -> float:
    """Return the share of diffuse light, by the clearness index (Erbs, Klein and Duffie 1982)."""
    clearness = irradiance / (1367.0 * height)
    if clearness <= 0.22:
        return 1.0 - 0.09 * clearness
    if clearness > 0.8:
        return 0.165
    k = clearness
    return 0.9511 - 0.1604 * k + 4.388 * k**2 - 16.638 * k**3 + 12.336 * k**4


def irradiance_on_south(sun: Sun, cloud_cover: float) -> float:
    """Return the irradiance on a vertical wall that looks south, in W/m2.

    The sky and the ground are isotropic (Liu and Jordan 1963).
    """
    ground = global_irradiance(sun.height, cloud_cover)
    if ground == 0.0:
        return 0.0
    diffuse = ground * diffuse_share(ground, sun.height)
    beam = (ground - diffuse) / sun.height * max(sun.on_south, 0.0)
    return beam + 0.5 * diffuse + 0.5 * REFLECTANCE_OF_GROUND * ground


def outside_temperature(day: int, hour: float, spell: float, cloud_cover: float) -> float:
    """Return the temperature of the air in degC.

    Args:
        day: Days since 1 January.
        hour: Of the day.
        spell: The weather of these days, with a standard deviation of 1.
        cloud_cover: From 0 to 1; a clear sky makes the days warmer and the nights colder.
    """
    season = -9.0 * math.cos(2 * math.pi * (day - 20) / DAYS)
    swing = 2.0 + 3.0 * (1.0 - cloud_cover)
    return 9.5 + season + 4.5 * spell + swing * math.cos(2 * math.pi * (hour - 15) / 24)


def internal_gains(day: int, hour: int) -> float:
    """Return the heat of people and appliances in W."""
    is_weekend = day % 7 >= 5
    if hour < 6 or hour >= 23:
        return 250.0
    if hour >= 17 or hour < 8:
        return 700.0
    return 550.0 if is_weekend else 150.0


def price(hour: int, sunshine: float, wind: float) -> float:
    """Return the price of electricity in EUR/kWh.

    Args:
        hour: Of the day.
        sunshine: Irradiance on the ground per 1,000 W/m2.
        wind: With a standard deviation of 1; much wind makes electricity cheap.
    """
    morning = 0.06 * math.exp(-(((hour - 7.5) / 1.5) ** 2))
    evening = 0.10 * math.exp(-(((hour - 18.5) / 2.0) ** 2))
    return max(0.28 + morning + evening - 0.12 * sunshine - 0.04 * wind, 0.05)


def year(seed: int = 13790) -> list[tuple[int, float, int, int, float]]:
    """Return the rows of the year, in the order of ``COLUMNS``."""
    rng = random.Random(seed)
    spells, clouds, winds = Noise(rng, 72.0), Noise(rng, 12.0), Noise(rng, 30.0)
    rows = []
    for number in range(24 * DAYS):
        day, hour = divmod(number, 24)
        cover = min(max(0.65 + 0.35 * clouds.step(), 0.0), 1.0)
        sun = sun_at(day, hour + 0.5)
        warmth = outside_temperature(day, hour + 0.5, spells.step(), cover)
        sunshine = global_irradiance(sun.height, cover) / 1000.0
        cost = price(hour, sunshine, winds.step())
        south = irradiance_on_south(sun, cover)
        gains = internal_gains(day, hour)
        rows.append((3600 * number, round(warmth, 1), round(south), round(gains), round(cost, 4)))
    return rows


def main() -> None:
    """Write the file."""
    with FILE.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows(year())


if __name__ == "__main__":
    main()
