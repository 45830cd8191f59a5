"""Fleets in CSV, and the checks of fleets that options share."""

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sb3_uav.missions.checks import MAX_FLEET, check_fits, check_fleet, check_fleet_size
from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.problem import make_instance
from sb3_uav.missions.read import read_fleet, read_fleet_from_bytes
from sb3_uav.missions.tasks import TaskList


def read(text):
    return read_fleet_from_bytes("f.csv", text.encode())


def refusal(text):
    """:return: The message with which a file is refused"""
    with pytest.raises(ValueError) as refused:
        read(text)
    message = str(refused.value)
    assert message.startswith("f.csv: ")
    assert "\n" not in message and len(message) < 500
    return message.removeprefix("f.csv: ")


def test_a_fleet(tmp_path):
    (tmp_path / "f.csv").write_text(
        "id,range_km,speed_kmh,reserve_percent,start,end,note\na,12,36,20,47.1 8.1,47.2;8.2,new\nb,7.5,,,,,\n"
    )
    fleet = read_fleet(tmp_path / "f.csv")
    assert fleet.uavs == (Uav("a", 12_000, 10, (47.1, 8.1), (47.2, 8.2), 20), Uav("b", 7_500))
    assert fleet.uavs[0].usable_m == pytest.approx(9_600)
    assert fleet.source == str(tmp_path / "f.csv")
    assert fleet.system is None


def test_endurance_times_speed():
    fleet = read("Name;Endurance [min];speed_mps\na;25;10\nb;12,5;20\n")
    assert [(uav.id, uav.range_m, uav.speed_mps) for uav in fleet] == [("a", 15_000, 10), ("b", 15_000, 20)]


def test_of_range_and_endurance_the_smaller_counts():
    fleet = read("id,range_m,endurance_s,speed_mps\na,1000,50,10\nb,1000,200,10\nc,1000,,10\nd,,50,10\ne,1000,,\n")
    assert [uav.range_m for uav in fleet] == [500, 1000, 1000, 500, 1000]


def test_uavs_without_names_are_numbered():
    assert [uav.id for uav in read("range_m\n1000\n2000\n")] == ["uav-1", "uav-2"]


def test_starts_and_ends_in_columns_of_their_own():
    fleet = read("id,range_m,start_lat,start_lng,end\na,1000,47.1,8.1,46 7\nb,1000,,,\n")
    assert fleet.system == "wgs84"
    assert [(uav.start, uav.end) for uav in fleet] == [((47.1, 8.1), (46, 7)), (None, None)]
    fleet = read("id,range_m,start_x,start_y\na,1000,470,-810\n")
    assert (fleet.system, fleet.uavs[0].start) == ("plane", (470, -810))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty; begin with a row that names the columns"),
        ("id,range_m\n", "there are 0 UAVs; give at least 1"),
        ("id,speed_mps\na,10\n", "no column says how far a UAV flies; found 'id, speed_mps'; name them id,range_m or"),
        ("id,endurance_min\na,10\n", "column 'endurance_min' needs a speed too; add a column speed_mps"),
        ("id,range\na,10\n", "column 'range' does not say its unit; name it range_m"),
        ("id,range_parsec\na,10\n", "column 'range_parsec': 'parsec' is no known unit; use range_m, range_km"),
        ("id,rnage_m\na,10\n", "column 'rnage_m': did you mean 'range_m'?"),
        ("id,range_m,capacity\na,10,1\n", "column 'capacity': payloads are not modeled"),
        ("id,range_m,max_range_km\na,10,1\n", "columns 'range_m' and 'max_range_km' both mean range"),
        ("id,range_m\na,10\nb,-5\n", "row 3: range_m is -5; give a number above 0"),
        ("id,range_m\na,0\n", "row 2: range_m is 0; give a number above 0"),
        ("id,range_m\na,\n", "row 2: range_m is missing"),
        ("id,range_m,endurance_s,speed_mps\na,,,3\n", "row 2: range_m and endurance_s is missing"),
        ("id,range_m\na,far\n", "row 2: range_m is 'far', which is no number"),
        ("id,range_m\na,1e12\n", "row 2: the range is 1e+12 m; give one above 0"),
        ("id,endurance_min,speed_mps\na,10,\n", "row 2: speed_mps is missing, which the endurance needs"),
        ("id,endurance_min,speed_mps\na,-10,1\n", "row 2: endurance_min is -10; give a number above 0"),
        ("id,range_m,speed_mps\na,10,0\n", "row 2: speed_mps is 0; give a number above 0"),
        ("id,range_m,reserve_percent\na,10,100\n", "row 2: the reserve is 100 %; give a percentage from 0 to below 100"),
        ("id,range_m,reserve_percent\na,10,-1\n", "row 2: the reserve is -1 %"),
        ("id,range_m\na,10\n\na,20\n", "row 4: id 'a' is that of row 2 too"),
        ("id,range_m\n,10\n", "row 2: id is ''; give a name"),
        ("id,range_m,start\na,10,47\n", "row 2: start: '47' is no position; write two numbers"),
        ("id,range_m,start_lat\na,10,47\n", "columns 'start_lat' do not fit together; give start_lat and start_lon"),
        ("id,range_m,end_lat,end_y\na,10,47,8\n", "columns 'end_lat, end_y' do not fit together"),
        ("id,range_m,start,start_x,start_y\na,10,1 2,3,4\n", "columns 'start, start_x, start_y' do not fit together"),
        ("id,range_m,start_lat,start_lon,end_x,end_y\na,10,1,2,3,4\n", "starts and ends mix lat, lon and x, y"),
        ("id,range_m,start_lat,start_lon\na,10,,8\n", "row 2: start_lat is missing"),
        ("id,range_m,start_lat,start_lon\na,10,98,47\n", "row 2: start_lat is 98; give degrees within 90; swapped?"),
        ('{"id": 1}', "this is no CSV; give the fleet as a CSV"),
        ("range_m\n" + "1000\n" * (MAX_FLEET + 1), f"row {MAX_FLEET + 2}: there are more than {MAX_FLEET} rows"),
    ],
)
def test_refusals(text, message):
    assert message in refusal(text)


@pytest.mark.parametrize(
    ("fleet", "message"),
    [
        (Fleet(()), "fleet: there are 0 UAVs"),
        (Fleet.of_equal(2, math.nan), "fleet: UAV 1: the range is nan m"),
        (Fleet.of_equal(2, math.inf), "fleet: UAV 1: the range is inf m"),
        (Fleet.of_equal(2, 0.0), "fleet: UAV 1: the range is 0 m"),
        (Fleet.of_equal(2, 10.0, -1.0), "fleet: UAV 1: the speed is -1 m/s"),
        (Fleet.of_equal(2, 10.0, math.nan), "fleet: UAV 1: the speed is nan m/s"),
        (Fleet.of_equal(2, 10.0, reserve_percent=100.0), "fleet: UAV 1: the reserve is 100 %"),
        (Fleet.of_equal(2, 10.0, reserve_percent=math.nan), "fleet: UAV 1: the reserve is nan %"),
        (Fleet((Uav("a", 1.0), Uav("b", 1.0, end=(1.0, math.nan)))), "fleet: UAV 2: end is 1, nan; give two finite numbers"),
        (Fleet((Uav("a", 1.0), Uav("a", 1.0))), "fleet: UAV 2: id 'a' is that of UAV 1 too"),
    ],
)
def test_fleets_of_options_are_checked(fleet, message):
    with pytest.raises(ValueError) as refused:
        check_fleet(fleet)
    assert message in str(refused.value)


def test_sizes_are_checked_before_there_is_a_fleet():
    check_fleet_size(1)
    check_fleet_size(MAX_FLEET)
    for size in (-1, 0, MAX_FLEET + 1, 2**31 - 1):
        with pytest.raises(ValueError, match=f"--uavs: there are {size} UAVs; give at least 1, and {MAX_FLEET} at most"):
            check_fleet_size(size, "--uavs")


def test_starts_are_in_the_coordinates_of_the_tasks():
    degrees = TaskList.of("a", [[47, 8]], "wgs84", source="t.csv")
    meters = TaskList.of("a", [[470, 8]], "plane", source="t.csv")
    by_columns = read("id,range_m,start_lat,start_lon\na,10,47,8\n")
    check_fits(degrees, by_columns)
    check_fits(meters, Fleet((Uav("a", 10.0),), system="wgs84"))
    with pytest.raises(ValueError, match=r"UAVs start or end at lat and lon, but t\.csv has x and y"):
        make_instance(meters.with_depot((0, 0)), by_columns)
    with pytest.raises(ValueError, match=r"f.csv: UAVs start or end at lat and lon, but t.csv has x and y; use one system"):
        check_fits(meters, by_columns)
    in_a_cell = read("id,range_m,start\na,10,470 8\n")
    check_fits(meters, in_a_cell)
    with pytest.raises(ValueError, match=r"f.csv: UAV a: start is 470, 8; give LAT,LON in degrees, within 90 and 180"):
        check_fits(degrees, in_a_cell)


@given(st.binary(max_size=60) | st.text(max_size=60).map(str.encode), st.integers(0, 80), st.integers(0, 80))
@example(b"\x00", 0, 0)
def test_any_bytes_are_read_or_refused(junk, start, end):
    valid = b"id,range_km,endurance_min,speed_kmh,start,reserve_percent\na,12,20,36,47 8,20\n"
    for data in (junk, valid[:start] + junk + valid[end:]):
        try:
            check_fleet(read_fleet_from_bytes("f.csv", data))
        except ValueError as error:
            assert str(error).startswith("f.csv: ") and len(str(error)) < 700
