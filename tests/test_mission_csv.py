"""Tasks in CSV: what is read, what is refused and with which words, and round trips."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_uav.missions.checks import check_tasks
from sb3_uav.missions.read import read_tasks, read_tasks_from_bytes
from sb3_uav.missions.readers import table
from sb3_uav.missions.tasks import TaskList
from sb3_uav.missions.writers.csv_tasks import tasks_to_csv, write_tasks_csv


def read(text, **options):
    return read_tasks_from_bytes("t.csv", text if isinstance(text, bytes) else text.encode(), **options)


def refusal(text, **options):
    """:return: The message with which a file is refused"""
    with pytest.raises(ValueError) as refused:
        read(text, **options)
    message = str(refused.value)
    assert message.startswith("t.csv: ")
    assert "\n" not in message and len(message) < 500
    return message.removeprefix("t.csv: ")


def test_all_columns():
    tasks = read(
        "id,lat,lon,value,service_s,must,alt_m,depot,note\n"
        "base,47.0,8.0,,,,,yes,\n"
        'a,47.1,8.1,3,30,yes,60,,"near, the wall"\n'
        "b,47.2,-8.2,0.5,0,no,,no,\n"
    )
    assert tasks.ids == ("a", "b")
    assert tasks.system == "wgs84"
    assert tasks.points.tolist() == [[47.1, 8.1], [47.2, -8.2]]
    assert tasks.depot.tolist() == [47.0, 8.0]
    assert tasks.values.tolist() == [3, 0.5]
    assert tasks.service_s.tolist() == [30, 0]
    assert tasks.must.tolist() == [True, False]
    assert tasks.altitudes[0] == 60 and math.isnan(tasks.altitudes[1])
    assert tasks.places == ("row 3", "row 4")
    assert tasks.source == "t.csv"


def test_only_positions():
    tasks = read("lon,lat\n8.1,47.1\n8.2,47.2\n", depot="47,8")
    assert tasks.ids == ("1", "2")
    assert tasks.points.tolist() == [[47.1, 8.1], [47.2, 8.2]]
    assert tasks.values.tolist() == [1, 1] and not tasks.service_s.any() and not tasks.must.any()
    assert tasks.depot.tolist() == [47, 8]


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_delimiters_line_ends_and_byte_order_marks(delimiter, end, mark):
    rows = ["Name ,LATITUDE, Lng ,Prize,Hold_min", '"x,1;y",47.1,8.1,2,1.5', "", '"two ""quotes""", 47.2 ,8.2,3,0', ",,,,"]
    text = mark + end.join(row.replace("x,1;y", "\0").replace(",", delimiter).replace("\0", "x,1;y") for row in rows) + end
    tasks = read(text)
    assert tasks.ids == ("x,1;y", 'two "quotes"')
    assert tasks.points.tolist() == [[47.1, 8.1], [47.2, 8.2]]
    assert tasks.values.tolist() == [2, 3]
    assert tasks.service_s.tolist() == [90, 0]
    assert tasks.places == ("row 2", "row 4")


def test_a_note_says_that_nothing_is_named():
    (note,) = read("iata,lat,long\nORD,41.98,-87.9\nSFO,37.6,-122.4\n").notes
    assert "the tasks are called 1, 2, ..." in note
    assert read("name,lat,long\nORD,41.98,-87.9\n").notes == ()


def test_tasks_that_are_near_the_depot_once_swapped():
    text = "id,lat,lon\na,8.55,47.39\nb,8.56,47.4\n"
    assert refusal(text, depot="47.4,8.5").startswith(
        "row 2: lat, lon are 8.55, 47.39, but the depot is at 47.4, 8.5: latitude and longitude look swapped"
    )
    assert "look swapped" in refusal("id,lat,lon,depot\nhome,47.4,8.5,yes\na,8.55,47.39,\n")
    # Far away all the same, near already, or no depot: nothing is known of a mistake.
    assert len(read(text, depot="60,8.5")) == len(read(text, depot="8.5,47.4")) == len(read(text)) == 2
    assert len(read("id,lat,lon\na,45,46\n", depot="46,45")) == 1


def test_a_spreadsheet_with_decimal_commas():
    tasks = read("sep=;\r\nid;type;lat;lon;priority\r\nhof;Depot;47,5;8,5;\r\nbaum;tree;47,51;-8,5;1e2\r\n")
    assert tasks.depot.tolist() == [47.5, 8.5]
    assert tasks.points.tolist() == [[47.51, -8.5]]
    assert tasks.values.tolist() == [100]
    assert tasks.places == ("row 4",)


def test_decimal_commas_before_three_digits():
    assert read("id;lat;lon\na;47,123;8,123\n").points.tolist() == [[47.123, 8.123]]
    assert read("id;x_m;y_m\na;1,234;0,5\n").points.tolist() == [[1.234, 0.5]]
    assert refusal("id;x_m;y_m\na;1,234;5\n") == "row 2: x_m is '1,234', which may be 1.234 or 1234; write one of them."


@pytest.mark.parametrize(
    ("header", "meters"),
    [("x_m,y_m", 1), ("x_km,y_km", 1000), ("X [ft],Y [ft]", 0.3048), ("East (km),North (km)", 1000), ("x,y", 1)],
)
def test_units_in_names(header, meters):
    tasks = read(f"id,{header}\na,100,200\nb,300,400.5\n")
    assert tasks.system == "plane"
    assert tasks.meters_per_unit == meters
    assert tasks.points.tolist() == [[100, 200], [300, 400.5]]


def test_the_unit_as_an_option():
    assert read("id,x,y\na,1.5,2\n", unit="km").meters_per_unit == 1000
    assert read("id,x_km,y_km\na,1.5,2\n", unit="km").meters_per_unit == 1000
    assert "'ft' contradicts column 'x_km'" in refusal("id,x_km,y_km\na,1.5,2\n", unit="ft")
    assert "is for x and y, but the file has lat and lon" in refusal("id,lat,lon\na,1.5,2\n", unit="km")


def test_rows_are_counted_as_by_text_editors():
    text = 'id,lat,lon,note\na,47,8,"two\nlines"\n\n\nb,47.5,oops,\n'
    assert refusal(text).startswith("row 6: lon is 'oops', which is no number")


TWO = "id,lat,lon\na,47,8\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty; begin with a row that names the columns"),
        ("\ufeff\n \n", "the file is empty"),
        ("id,lat,lon\n", "there is no task below the header"),
        ("id,lat,lon,depot\na,47,8,1\n", "there is no task below the header"),
        ("a,47,8\nb,48,8\n", "the first row, 'a,47,8', looks like data; put a row before it"),
        ("47,8\n48,8\n", "the first row, '47,8', looks like data"),
        ("id,color\na,red\n", "no columns give positions; found 'id, color'; name them id,lat,lon or id,x_m,y_m"),
        ("id,lat,color\na,47,red\n", "there is no column lon beside 'lat'"),
        ("id,lat,lon,x,y\na,47,8,1,2\n", "columns 'lat' and 'lon' and 'x' and 'y' mix two systems"),
        ("id,lat,y\na,47,8\n", "columns 'lat' and 'y' mix two systems"),
        ("id,lat,lon,latitude\na,47,8,47\n", "columns 'lat' and 'latitude' both mean lat; remove one"),
        ("id,id,lat,lon\na,b,47,8\n", "columns 'id' and 'id' both mean id"),
        ("id,lat,lon,vlaue\na,47,8,1\n", "column 'vlaue': did you mean 'value'?"),
        ("id,lat,lon,service_sek\na,47,8,1\n", "column 'service_sek': 'sek' is no known unit; use service_s, service_min"),
        ("id,lat,lon,servce_s\na,47,8,1\n", "column 'servce_s': did you mean 'service_s'?"),
        ("id,lat,lon,value_eur\na,47,8,1\n", "column 'value_eur': did you mean 'value'?"),
        ("id,latt,lon\na,47,8\n", "column 'latt': did you mean 'lat'?"),
        ("id,x_parsec,y_parsec\na,47,8\n", "column 'x_parsec': 'parsec' is no known unit; use x_m, x_km"),
        ("id,x_m,y_km\na,47,8\n", "columns 'x_m' and 'y_km' differ in their unit"),
        ("id,x_m,y\na,47,8\n", "columns 'x_m' and 'y' differ in their unit"),
        ("id,lat,lon,service\na,47,8,1\n", "column 'service' does not say its unit; name it service_s"),
        ("id,lat,lon,alt\na,47,8,1\n", "column 'alt' does not say its unit; name it alt_m"),
        ("id,lat,lon,tw_start\na,47,8,1\n", "column 'tw_start': time windows are not modeled"),
        ("id,lat,lon,Demand\na,47,8,1\n", "column 'Demand': payloads are not modeled"),
        (TWO + "b,47\n", "row 3: there are 2 cells, but the header has 3, separated by commas"),
        (
            TWO + "b,47,1,8,2\n",
            "there are 5 cells, but the header has 3, separated by commas; numbers with a decimal comma",
        ),
        (TWO + "b,,8\n", "row 3: lat is missing; fill the cell"),
        (TWO + ",47.5,8\n", "row 3: id is missing; fill the cell"),
        (TWO + "b,nan,8\n", "row 3: lat is 'nan', which is no number"),
        (TWO + "b,inf,8\n", "row 3: lat is 'inf', which is no number"),
        (TWO + "b,1e999,8\n", "row 3: lat is '1e999'; give a finite number"),
        (TWO + "b,4_7,8\n", "row 3: lat is '4_7', which is no number"),
        (TWO + "b,47°30'N,8\n", 'row 3: lat is "47°30\'N", which is no number'),
        (TWO + 'b,"47,5",8\n', "row 3: lat is '47,5', which is no number; decimals need a point"),
        (TWO + "b,95.5,200\n", "row 3: lat is 95.5; degrees must be within 90"),
        (TWO + "b,47,200\n", "row 3: lon is 200; longitudes are from -180 to 180 degrees; add or subtract 360"),
        (TWO + "b,151.2,-33.8\n", "row 3: lat is 151.2; latitudes are within 90 degrees, and lon is -33.8: are they swapped?"),
        (TWO + "b,5200000,680000\n", "row 3: lat is 5200000; that looks like meters, not degrees"),
        (TWO + "b,0,0\n", "row 3: lat and lon are both 0"),
        (TWO + "a,47.5,8\n", "row 3: id 'a' is that of row 2 too"),
        (TWO + "b,47.0,8e0\n", "row 3: task b is where task a (row 2) is, at 47, 8; remove one, or give --allow-duplicates"),
        ("id,lat,lon\na,10,180\nb,10,-180\n", "row 3: task b is where task a (row 2) is"),
        ("id,x,y\na,8.1,47.1\nb,8.2,47.2\n", "row 2: x, y are 8.1, 47.1, and all points look like degrees; if so, name"),
        ("id,x_m,y_m\na,1e10,2\n", "row 2: x is 10000000000; coordinates must be within 1e+09 of the origin"),
        ("id,lat,lon,value\na,47,8,-1\n", "row 2: value is '-1'; give a number of at least 0"),
        ("id,lat,lon,value\na,47,8,\n", "row 2: value is missing"),
        ("id,lat,lon,service_min\na,47,8,-1\n", "row 2: service_min is '-1'; give a number of at least 0"),
        ("id,lat,lon,must\na,47,8,perhaps\n", "row 2: must is 'perhaps'; write yes or no"),
        ("id,lat,lon,alt_m\na,47,8,20000\n", "row 2: alt_m is 20000; give a number from -1000 to 10000"),
        ("id,lat,lon,depot\na,47,8,1\nb,46,8,1\nc,45,8,\n", "row 3: a second depot, after that in row 2"),
        ("id,lat,lon,depot\na,99,8,1\nb,46,8,\n", "row 2: lat is 99; latitudes are within 90 degrees"),
        (
            "id;lat;lon\na;47,1;8,2\nb;47.1;8\n",
            "row 2: lat is '47,1', but row 3 has '47.1' as lat; use either commas",
        ),
        ("id;lat;lon\na;1.047,1;8,2\n", "row 2: lon is '8,2', but row 2 has '1.047,1' as lat"),
        (TWO + f"{'b' * 201},47.5,8\n", "has 201 characters; give a name of at most 200"),
        (TWO + '"b\nc",47.5,8\n', "row 3: id is 'b\\nc', with a control character"),
        (TWO + "b\u202ec,47.5,8\n", "row 3: id is 'b\\u202ec', with a control character"),
        (TWO + "b\0,47.5,8\n", "row 3: the file holds the control character '\\x00'"),
        (TWO + '"b,47.5,8\n', "row 3: this is no CSV (unexpected end of data); look for a quote"),
        (TWO + '"b' + "\n" * 200, "row 3: more than 100 lines are in quotes; look for a quote that is not closed"),
        (TWO + "b," + " " * 200_000 + "47.5,8\n", "row 3: 200009 characters are in the line"),
        (",".join(f"c{n}" for n in range(2_000)), "row 1: there are 2000 columns, but at most 1000 are read"),
    ],
)
def test_refusals(text, message):
    assert message in refusal(text)


def test_other_encodings():
    assert refusal("id,lat,lon\nMüller,47,8\n".encode("latin-1")) == (
        "row 2: byte 0xfc at offset 12 is not UTF-8; save the file as UTF-8."
    )
    assert refusal("\ufeffid,lat,lon\r\nMüller,47,8\n".encode()[:-9] + b"\xff") == (
        "row 2: byte 0xff at offset 19 is not UTF-8; save the file as UTF-8."
    )
    for encoding in ("utf-16-le", "utf-16-be"):
        assert refusal("\ufeffid,lat,lon\na,47,8\n".encode(encoding)) == "the file is UTF-16; save it as UTF-8."


def test_other_columns_are_ignored():
    tasks = read("name;id;lat;lon;species;lat_accuracy;notes\nPear;p1;47;8;pyrus;3;\nPear;p2;47,5;8;pyrus;;\n")
    assert tasks.ids == ("p1", "p2")


def test_a_depot_beside_a_flagged_row():
    text = "id,lat,lon,depot\na,47,8,x\nb,46,8,\n"
    assert "one of the points is the depot already" in refusal(text, depot="47,8")
    assert read(text).depot.tolist() == [47, 8]


def test_duplicates_may_be_allowed():
    assert len(read(TWO + "b,47,8\n", allow_duplicates=True)) == 2


def test_too_many_rows(monkeypatch):
    text = "id,x_m,y_m\n" + "".join(f"{n},{n},0\n" for n in range(100_002))
    assert refusal(text) == "row 100003: there are more than 100001 rows; divide the file."
    # The rows are not even looked at.
    monkeypatch.setattr(table, "csv", None)
    assert refusal("\n" * 500_001) == "there are 500001 rows, but at most 100001 are read; divide the file."


def test_nothing_is_read_beyond_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_uav.missions.read.MAX_BYTES", 100)
    path = tmp_path / "large.csv"
    path.write_text("id,lat,lon\n" + "#" * 2**21)
    with pytest.raises(ValueError, match=r"the file has 2\.0 MiB, but at most 0 MiB are read; divide it"):
        read_tasks(path)


NAMES = (
    st.text(st.characters(exclude_categories=("Cc", "Cs", "Zl", "Zp")), min_size=1, max_size=12).map(str.strip).filter(bool)
)
# No text that reverses what follows.
NAMES = NAMES.filter(lambda name: not any("\u202a" <= char <= "\u202e" or "\u2066" <= char <= "\u2069" for char in name))
AMOUNTS = st.floats(0, 1e9)


@st.composite
def task_lists(draw):
    """Tasks on either side of equator and antimeridian, or in a plane."""
    system = draw(st.sampled_from(["wgs84", "plane"]))
    n_tasks = draw(st.integers(1, 6))
    limits = (90, 180) if system == "wgs84" else (1e5, 1e5)
    point = st.tuples(*(st.floats(-limit, limit) for limit in limits))
    if system == "wgs84":
        point = point.filter(any)
    return TaskList.of(
        draw(st.lists(NAMES, min_size=n_tasks, max_size=n_tasks, unique=True)),
        draw(st.lists(point, min_size=n_tasks, max_size=n_tasks)),
        system,
        draw(st.lists(AMOUNTS, min_size=n_tasks, max_size=n_tasks)),
        draw(st.lists(AMOUNTS, min_size=n_tasks, max_size=n_tasks)),
        draw(st.lists(st.booleans(), min_size=n_tasks, max_size=n_tasks)),
        depot=draw(st.none() | point),
        altitudes=np.array(draw(st.lists(st.just(math.nan) | st.floats(-100, 9_000), min_size=n_tasks, max_size=n_tasks))),
        meters_per_unit=1.0 if system == "wgs84" else draw(st.sampled_from([1.0, 1000.0, 0.3048, 1852.0])),
    )


def is_in_order(tasks):
    """Whether the depot is not where the tasks would be with latitude and longitude swapped, which is refused."""
    return tasks.depot is None or (np.abs(tasks.points[:, ::-1] - tasks.depot) > 2).any()


@given(task_lists().filter(is_in_order))
def test_round_trip(tasks):
    check_tasks(tasks, allow_duplicates=True)
    again = read(tasks_to_csv(tasks), allow_duplicates=True)
    assert (again.ids, again.system, again.meters_per_unit) == (tasks.ids, tasks.system, tasks.meters_per_unit)
    for name in ("points", "values", "service_s", "must", "altitudes"):
        np.testing.assert_array_equal(getattr(again, name), getattr(tasks, name), err_msg=name)
    np.testing.assert_array_equal(again.depot, tasks.depot)


def test_a_unit_without_a_name_becomes_meters(tmp_path):
    tasks = TaskList.of("ab", [[1, 2], [3, 4]], "plane", depot=(0, 0), meters_per_unit=2.5)
    write_tasks_csv(tasks, tmp_path / "t.csv")
    again = read_tasks(tmp_path / "t.csv")
    assert (again.meters_per_unit, again.points.tolist()) == (1, [[2.5, 5], [7.5, 10]])
    assert (tmp_path / "t.csv").read_text().splitlines()[:2] == ["id,x_m,y_m,value,depot", "depot,0.0,0.0,,yes"]
