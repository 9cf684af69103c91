"""Changed copies of frozen dataclasses."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import pytest

from calibgraph.tracking.frozen import changed


@dataclass(frozen=True)
class Square:
    side_m: float
    name: str = ""

    @cached_property
    def area_m2(self) -> float:
        return self.side_m**2


@dataclass(frozen=True)
class Checked:
    side_m: float

    def __post_init__(self) -> None:
        if self.side_m < 0:
            raise ValueError("must not be negative")


def test_a_copy_has_the_other_fields_and_computes_anew() -> None:
    one = Square(2.0, "small")
    assert one.area_m2 == 4.0
    other = changed(one, side_m=3.0)
    assert (other, other.area_m2, one.area_m2) == (Square(3.0, "small"), 9.0, 4.0)


def test_an_unknown_field_is_refused() -> None:
    with pytest.raises(TypeError, match="no fields"):
        changed(Square(2.0), height_m=1.0)


def test_a_class_that_checks_its_fields_is_refused() -> None:
    with pytest.raises(TypeError, match="use dataclasses"):
        changed(Checked(2.0), side_m=-1.0)
