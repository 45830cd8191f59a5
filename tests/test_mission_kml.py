"""KML of plans, and the names of mission files."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from mission_format_helpers import DEPOT, plan_at_the_antimeridian, plane_plan

from sb3_uav.envs.schedule import Schedule
from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.flight import FlightOptions
from sb3_uav.missions.search import make_plan
from sb3_uav.missions.tasks import TaskList
from sb3_uav.missions.writers.kml import write_kml
from sb3_uav.missions.writers.names import file_stems

KML = "{http://www.opengis.net/kml/2.2}"
UP = FlightOptions(altitude_m=50, altitude_step_m=10)


def written(plan, tmp_path):
    write_kml(plan, tmp_path / "routes.kml", UP)
    return ElementTree.parse(tmp_path / "routes.kml").getroot()


def vertices(element):
    return [tuple(map(float, vertex.split(","))) for vertex in element.find(f".//{KML}coordinates").text.split()]


def test_folders_lines_and_stops(tmp_path):
    pytest.importorskip("pyproj")
    root = written(plan_at_the_antimeridian(), tmp_path)
    folders = {folder.findtext(f"{KML}name"): folder for folder in root.iter(f"{KML}Folder")}
    assert list(folders) == ["one", "two", "three", "Skipped tasks"]
    assert {mode.text for mode in root.iter(f"{KML}altitudeMode")} == {"relativeToGround"}
    names = [placemark.findtext(f"{KML}name") for placemark in folders["one"].iter(f"{KML}Placemark")]
    assert names == ["Route of one", "1: a", "2: b & <b>"]
    assert vertices(folders["one"].findall(f"{KML}Placemark")[2]) == [(-179.99, -17.01, 30.0)]
    (line,) = folders["two"].iter(f"{KML}LineString")
    assert vertices(line) == [(DEPOT[1], DEPOT[0], 60), (179.98, -17.0, 60), (DEPOT[1], DEPOT[0], 60)]
    assert "10 s" in folders["one"].findall(f"{KML}Placemark")[2].findtext(f"{KML}description")
    skipped = folders["Skipped tasks"].find(f"{KML}Placemark")
    assert skipped.findtext(f"{KML}name") == "far"
    assert skipped.findtext(f"{KML}description").startswith("out of reach, ")
    depot = root.find(f"{KML}Document/{KML}Placemark")
    assert (depot.findtext(f"{KML}name"), vertices(depot)) == ("Depot", [(DEPOT[1], DEPOT[0], 0)])


def test_lines_are_cut_at_the_antimeridian_with_their_altitudes(tmp_path):
    pytest.importorskip("pyproj")
    lines = [vertices(line) for line in written(plan_at_the_antimeridian(), tmp_path).iter(f"{KML}LineString")][:3]
    assert [line[0] for line in lines[1:]] == [
        (-180, pytest.approx(-17.005), pytest.approx(40)),
        (180, pytest.approx(-17.01 + 2 / 300), pytest.approx(30 + 40 / 3)),
    ]


def test_every_line_has_a_style(tmp_path):
    pytest.importorskip("pyproj")
    tasks = TaskList.of(range(10), [(47 + n / 1000, 8) for n in range(10)], "wgs84", depot=(47.0, 8.01))
    plan = make_plan(tasks, Fleet.of_equal(10, 9_000), Schedule([[n] for n in range(10)]), "by hand")
    root = written(plan, tmp_path)
    styles = {f"#{style.get('id')}" for style in root.iter(f"{KML}Style")}
    used = [url.text for url in root.iter(f"{KML}styleUrl")]
    assert len(used) == 10
    assert set(used) == styles


def test_names_that_xml_cannot_hold(tmp_path):
    pytest.importorskip("pyproj")
    names = ["<a>&\"'", "null\0", "bell\x07", "half \ud800", "]]>", "\U0001f681"]
    tasks = TaskList.of(names, [(47 + n / 1000, 8) for n in range(6)], "wgs84", depot=(47.0, 8.0), source="x\x1b.csv")
    plan = make_plan(tasks, Fleet.of_equal(1, 9_000), Schedule([range(6)]), "by hand")
    found = [placemark.findtext(f"{KML}name") for placemark in written(plan, tmp_path).iter(f"{KML}Placemark")]
    assert found[2:] == ["1: <a>&\"'", "2: null\ufffd", "3: bell\ufffd", "4: half \ufffd", "5: ]]>", "6: \U0001f681"]


def test_planes_are_refused(tmp_path):
    with pytest.raises(ValueError, match="the tasks are in a plane of x and y, but KML files need latitudes"):
        write_kml(plane_plan(), tmp_path / "routes.kml", UP)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("ids", "stems"),
    [
        (["uav-1", "uav 2", "Ünal"], ["uav-1", "uav_2", "nal"]),
        (["a", "A", "a"], ["a", "A-2", "a-3"]),
        (["a", "a", "a-2"], ["a", "a-2", "a-2-2"]),
        (["../../etc/passwd", "..", "/", ""], ["etc_passwd", "uav-2", "uav-3", "uav-4"]),
        (["con", "NUL.txt", "com1", "console"], ["uav-1-con", "uav-2-NUL.txt", "uav-3-com1", "console"]),
        (["a..b", "a\0b", ".hidden", "dot."], ["a.b", "a_b", "hidden", "dot"]),
        (["x" * 300], ["x" * 80]),
    ],
)
def test_file_names(ids, stems):
    tasks = TaskList.of(["t"], np.zeros((1, 2)), "plane", depot=(0, 0))
    fleet = Fleet(tuple(Uav(name, 10.0) for name in ids))
    assert list(file_stems(make_plan(tasks, fleet, Schedule([[]] * len(ids)), "by hand"))) == stems
