"""What contributors and CI use: commit subjects, hooks, dependency floors, workflow."""

import configparser
import re
import subprocess
import sys
from pathlib import Path

import pytest

from scripts.check_subject import problems

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(("subject", "is_fine"), [("x" * 72, True), ("x" * 73, False), ("", False), ("Fix the mask", True)])
def test_subjects_have_1_to_72_characters(subject, is_fine):
    assert (problems([subject]) == []) is is_fine


def test_commit_message_hook_reads_the_first_line_that_is_no_comment(tmp_path):
    message = tmp_path / "message"
    message.write_text("# a comment of git, which may be very long " + "x" * 72 + "\nA subject\n\n" + "a long body " * 20)
    script = [sys.executable, str(ROOT / "scripts" / "check_subject.py"), str(message)]
    assert subprocess.run(script).returncode == 0
    message.write_text("x" * 73 + "\n")
    failed = subprocess.run(script, capture_output=True, text=True)
    assert failed.returncode == 1 and "73 characters" in failed.stderr


def test_oldest_constraints_are_the_floors_of_setup_cfg():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg", encoding="utf-8")
    text = config["options"]["install_requires"] + "".join(config["options.extras_require"].values())
    floors = dict(re.findall(r"^([\w-]+)>=([\d.]+)", text, flags=re.MULTILINE))
    pins = dict(
        re.findall(r"^([\w-]+)==([\d.]+)$", (ROOT / "constraints-oldest.txt").read_text(encoding="utf-8"), re.MULTILINE)
    )
    assert {"stable-baselines3", "sb3-contrib", "gymnasium", "numpy", "rl-zoo3"} == set(pins)
    for name, version in pins.items():
        assert version.startswith(floors[name]), f"{name}: {version} is tested, setup.cfg allows {floors[name]}"


def test_hooks_run_the_checks_of_ci():
    hooks = (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8")
    run = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    (targets,) = re.findall(r"for target in ([\w\s-]+); do", run)
    assert re.findall(r"entry: make ([\w-]+)", hooks) == targets.split()


def test_workflow_covers_all_pythons_and_the_ends_of_the_version_ranges():
    workflow = (ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8")
    classifiers = re.findall(r"Python :: (3\.\d+)", (ROOT / "setup.cfg").read_text(encoding="utf-8"))
    assert re.findall(r'"(3\.\d+)"', re.findall(r"python-version: \[(.*)\]", workflow)[0]) == classifiers
    assert "CONSTRAINTS=constraints-oldest.txt" in workflow and "CONSTRAINTS= " in workflow


@pytest.mark.parametrize("path", sorted((ROOT / ".github" / "workflows").glob("*.yml")), ids=lambda path: path.name)
def test_actions_are_named_by_hash(path):
    """A tag can be moved."""
    uses = re.findall(r"uses: (\S+)", path.read_text(encoding="utf-8"))
    assert uses and all(re.fullmatch(r"[\w/-]+@[0-9a-f]{40}", use) for use in uses)


def test_the_version_is_the_same_everywhere():
    version = (ROOT / "sb3_uav" / "version.txt").read_text(encoding="utf-8").strip()
    (cited,) = re.findall(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), flags=re.MULTILINE)
    newest = re.findall(r"^## Release (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.MULTILINE)[0]
    assert version == cited == newest


def test_publishing_builds_once_and_tries_the_wheel_on_every_python():
    workflow = (ROOT / ".github" / "workflows" / "publish.yml").read_text(encoding="utf-8")
    classifiers = re.findall(r"Python :: (3\.\d+)", (ROOT / "setup.cfg").read_text(encoding="utf-8"))
    assert re.findall(r'"(3\.\d+)"', re.findall(r"python-version: \[(.*)\]", workflow)[0]) == classifiers
    assert workflow.count("-m build\n") == 1 and "needs: try" in workflow and "id-token: write" in workflow
