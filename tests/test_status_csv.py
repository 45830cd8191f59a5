"""Status files: what they say, and what is wrong with them, by row."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_uav.missions.readers.status_csv import read_status, read_status_from_bytes
from sb3_uav.missions.status import NewTask, Status, UavReport

HEAD = "what,id,lat,lon,remaining_m,value,service_s,must\n"


def read(text: str) -> Status:
    return read_status_from_bytes(text.encode(), "status.csv")


def test_all_kinds_of_rows(tmp_path):
    path = tmp_path / "status.csv"
    path.write_text(
        HEAD
        + "uav,uav-1,47.3812,8.5412,5200,,,\n"
        + "uav,uav-2,,,3100\n"
        + "lost,uav-3\n"
        + "done,t17\n"
        + "\n"
        + "done, t4\n"
        + "drop,t40,47.1,8.2,,9\n"
        + "task,new-1,47.3811,8.5523,,5,20,yes\n"
        + "task,new-2,47.3811,8.5524\n"
    )
    status = read_status(path)
    assert status.uavs == (UavReport("uav-1", (47.3812, 8.5412), 5200.0), UavReport("uav-2", None, 3100.0))
    assert (status.lost, status.done, status.dropped) == (("uav-3",), ("t17", "t4"), ("t40",))
    assert [task.id for task in status.tasks] == ["new-1", "new-2"]
    assert status.tasks[0] == NewTask("new-1", (47.3811, 8.5523), 5.0, 20.0, True, status.tasks[0].altitude_m)
    assert math.isnan(status.tasks[0].altitude_m)
    assert (status.tasks[1].value, status.tasks[1].service_s, status.tasks[1].must) == (1.0, 0.0, False)
    assert status.system == "wgs84"
    assert status.place("done", "t4") == f"{path}: row 7"
    assert status.place("task", "elsewhere") == f"{path}: task elsewhere"


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_what_spreadsheets_write(delimiter, ending):
    rows = ["What,Name,x,y,remaining_percent,note,,", 'uav,"a",1.5,-2,55,"two, or three",,', "done,b,,,,,,"]
    text = ending.join(row.replace(",", delimiter) for row in rows)
    status = read_status_from_bytes(b"\xef\xbb\xbf" + text.encode(), "status.csv")
    assert status.uavs == (UavReport("a", (1.5, -2.0), 55.0, "percent"),)
    assert (status.done, status.system) == (("b",), "plane")


def test_a_status_without_places():
    status = read("what,id\ndone,t1\nlost,uav-1\n")
    assert (status.done, status.lost, status.system) == (("t1",), ("uav-1",), None)
    assert read("what,id\n") == Status(source="status.csv")


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("uav,a,8.5,197.2,100", "row 2: lon is 197.2; give a number from -180 to 180"),
        ("uav,a,147.2,8.5,100", "row 2: lat is 147.2, which is out of range, and lon 8.5; the two look swapped"),
        ("uav,a,95,95,100", "row 2: lat is 95; give a number from -90 to 90"),
        ("uav,a,47.2,,100", "row 2: lat is 47.2, but lon is empty"),
        ("uav,a,nan,8,100", "row 2: lat is nan; give a number"),
        ("uav,a,47.2,8.5,-3", "row 2: remaining_m is -3; give a number from 0"),
        ("uav,a,47.2,8.5,inf", "row 2: remaining_m is inf"),
        ("uav,a,47.2,8.5,1_0", "row 2: remaining_m is 1_0"),
        ("uav,a,47.2,8.5,5km", "row 2: remaining_m is '5km', which is no number; write digits only"),
        ('uav,a,"47,2",8.5,5', "row 2: lat is '47,2', which is no number; write decimals with a point"),
        ("uav,a,47.2,8.5,", "row 2: this says where UAV a is, but not how far it still flies; give remaining_m"),
        ("uav,a", "row 2: this says neither where UAV a is nor how far"),
        ("uav,a,47.2,8.5,5,9", "row 2: value is 9, but this is a UAV"),
        ("task,a,47.2,8.5,5", "row 2: remaining_m is 5, but this is a task"),
        ("task,a", "row 2: lat and lon are empty; say where task a is"),
        ("task,a,47.2,8.5,,-1", "row 2: value is -1"),
        ("task,a,47.2,8.5,,1,1,maybe", "row 2: must is 'maybe'; write yes or no"),
        ("don,a", "row 2: what is 'don'; did you mean done?"),
        (",a", "row 2: what is ''"),
        ("done,", "row 2: id is empty; name the task"),
        ("lost,", "row 2: id is empty; name the UAV"),
        ("done," + "a" * 201, "row 2: id has 201 characters"),
        ("done,a\n\ndone,a", "row 4: done a stands in row 2 already"),
        ("uav,a,,,5\nlost,a", "UAV a stands in row 2 (uav) and in row 3 (lost)"),
        ("drop,a\ndone,a", "task a stands in row 3 (done) and in row 2 (drop)"),
        ("done,a,,,,,,,,7", "row 2: there are 10 cells, but the first row names 8 columns"),
    ],
)
def test_wrong_rows(rows, message):
    with pytest.raises(ValueError) as error:
        read(HEAD + rows + "\n")
    assert str(error.value).startswith("status.csv: ")
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "the file is empty"),
        (b"\n , ,\n", "the file is empty"),
        (b"done,t1\n", "row 1: column 'done' is not known"),
        (b"what,lat,lon\n", "row 1: there is no column id"),
        (b"id,lat,lon\n", "row 1: there is no column what"),
        (b"what,id,latt\n", "row 1: column 'latt' is not known; did you mean lat?"),
        (b"what,id,id\n", "row 1: there are several columns for id"),
        (b"what,id,lat\n", "row 1: coordinates are lat; give lat and lon, or x and y"),
        (b"what,id,lat,lon,x,y\n", "row 1: coordinates are lat and lon and x and y"),
        (b"what,id,remaining_m,remaining_min\nuav,a,5,5\n", "row 2: remaining_m and remaining_min both say"),
        (b"what,id,remaining_percent\nuav,a,101\n", "row 2: remaining_percent is 101; give a number from 0 to 100"),
        ("what,id\ndone,é\n".encode("latin-1"), "row 2: byte 0xe9 at offset 13 is not UTF-8"),
        ("what,id\ndone,a\n".encode("utf-16"), "the file is UTF-16; save it as UTF-8"),
        (b"what,id\ndone,a\0\n", "row 2: the file holds the control character '\\x00'"),
        (b"what,id\ndone," + b"a" * 200_000, "this is no CSV file (field larger than field limit"),
        (b'what,id\ndone,"a\nlost,b\n', "this is no CSV file (unexpected end of data); look for a quote that is not closed"),
        (b"what,id\n" * (10 * 2**17 + 1), "the file has more than 10 MB"),
    ],
)
def test_wrong_files(data, message):
    with pytest.raises(ValueError) as error:
        read_status_from_bytes(data, "status.csv")
    assert str(error.value).startswith("status.csv: ")
    assert message in str(error.value)


CELLS = st.one_of(st.sampled_from(["uav", "done", "a", "1e400", "-1", "nan", '"', ";", "\r", "yes", ""]), st.text(max_size=5))


@settings(max_examples=100, deadline=None)
@given(st.lists(st.lists(CELLS, max_size=9).map(",".join), max_size=5), st.binary(max_size=4))
def test_whatever_stands_in_a_file(rows, end):
    try:
        read_status_from_bytes(HEAD.encode() + "\n".join(rows).encode("utf-8", "replace") + end, "status.csv")
    except ValueError as error:
        assert str(error).startswith("status.csv: ")
