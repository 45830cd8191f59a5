"""Units and positions as people write them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_uav.missions.units import length_unit, number_of, parse_duration, parse_length, parse_point, parse_speed


@pytest.mark.parametrize(
    ("parse", "text", "expected"),
    [
        (parse_length, "12km", 12_000),
        (parse_length, " 12.5 KM ", 12_500),
        (parse_length, "12000", 12_000),
        (parse_length, "1e3 m", 1_000),
        (parse_length, "10ft", 3.048),
        (parse_length, "1 mi", 1_609.344),
        (parse_length, "2nmi", 3_704),
        (parse_length, "-5km", -5_000),
        (parse_speed, "10", 10),
        (parse_speed, "10 m/s", 10),
        (parse_speed, "36km/h", 10),
        (parse_speed, "36 kmh", 10),
        (parse_speed, "10kn", 5.144444),
        (parse_speed, "10 mph", 4.4704),
        (parse_duration, "90", 90),
        (parse_duration, "1.5min", 90),
        (parse_duration, "2 h", 7_200),
    ],
)
def test_quantities(parse, text, expected):
    assert parse(text) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("parse", "text", "message"),
    [
        (parse_length, "", "is no length"),
        (parse_length, "far", "is no length"),
        (parse_length, "12,5km", "',5km' is no unit of length; write one of m, km"),
        (parse_length, "12 parsec", "'parsec' is no unit of length"),
        (parse_length, "1e999m", "no finite length"),
        (parse_length, "nan", "is no length"),
        (parse_length, "inf km", "is no length"),
        (parse_length, "1_000", "is no unit of length"),
        (parse_length, "1" * 10**6, "is no length"),
        (parse_speed, "10 knots per hour", "is no unit of speed"),
        (parse_duration, "25m", "m are meters; minutes are min"),
    ],
)
def test_other_quantities_are_refused(parse, text, message):
    with pytest.raises(ValueError, match=message) as refused:
        parse(text)
    assert len(str(refused.value)) < 250


@pytest.mark.parametrize("text", ["47.1,8.2", "47.1, 8.2", " 47.1;8.2", "47.1 8.2", "+47.1\t8.20"])
def test_points(text):
    assert parse_point(text) == (47.1, 8.2)


@pytest.mark.parametrize("text", ["", "47.1", "47,1,8,2", "47.1,8.2,9", "47.1,", "47.1;nan", "1e999,1", "47N,8E", "," * 10**6])
def test_other_points_are_refused(text):
    with pytest.raises(ValueError, match="is no position; write two numbers, LAT,LON in degrees or X,Y"):
        parse_point(text)


@given(st.floats(allow_nan=False, allow_infinity=False), st.floats(allow_nan=False, allow_infinity=False))
def test_points_are_read_without_loss(first, second):
    assert parse_point(f"{first!r},{second!r}") == (first, second)


@pytest.mark.parametrize("text", ["1_000", "0x10", "nan", "inf", "１２", "1e", ".", "1 2", "--1", ""])  # noqa: RUF001
def test_what_python_reads_is_not_always_a_number(text):
    with pytest.raises(ValueError, match="is no number"):
        number_of(text)


def test_a_unit_of_length():
    assert length_unit("KM") == 1_000
    with pytest.raises(ValueError, match="'furlong' is no unit of length; give one of m, km"):
        length_unit("furlong")
