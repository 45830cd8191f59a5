"""What is fuzzed: every reader of files with small valid files of its format, made by the code itself."""

from __future__ import annotations

import contextlib
import io
import json
import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import _fuzz_mutations as mutations
import numpy as np
import torch as th
import yaml
from web_load import _SEEDS

from sb3_uav.envs import Instances, UniformGenerator
from sb3_uav.evaluation import evaluate
from sb3_uav.missions.plan_file import load_plan, plan_to_json
from sb3_uav.missions.read import read_fleet, read_tasks
from sb3_uav.missions.readers.status_csv import read_status
from sb3_uav.missions.search import solve
from sb3_uav.policies import AllocatorPolicy, RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.solvers import make_solver
from sb3_uav.training.fixed_set_history import EvaluationHistory, FixedSetResult
from sb3_uav.training.imitation_progress import ImitationProgress, Lesson
from sb3_uav.training.instance_sets import SizeTable
from sb3_uav.training.its_checkpoint import read_state

Change = Callable[..., bytes]
NETWORK: dict[str, Any] = {"embed_dim": 8, "n_layers": 1, "n_heads": 2, "ff_dim": 8, "bias_dim": 8}
# Values of a training that runs in the fuzz: no sizes that are legal and slow.
_SMALL = tuple(value for value in mutations.VALUES if not isinstance(value, int) or value < 100 or value > 2**40)
_ENV = "TaskAllocation-U2-N5-v0"


@dataclass
class Reader:
    """
    :param name: What is read
    :param weight: Its share of all cases
    :param file: Name of the file, whose suffix may count
    :param corpus: Valid contents
    :param change: Damages one: takes a random generator, the content and all others
    :param read: Reads the file; returns or raises an error that names it
    :param beside: Further files of its folder, written before each case
    :param may_take_long: Whether time that is up is no failure: a training of a thousand epochs is legal
    :param must_name: What the message must contain, if not the name of the file; if nothing, it may be as long as what is read
    """

    name: str
    weight: int
    file: str
    corpus: Sequence[bytes]
    change: Change
    read: Callable[[Path], Any]
    beside: Mapping[str, bytes] = field(default_factory=dict)
    must_name: str | None = None
    may_take_long: bool = False


def all_readers() -> list[Reader]:
    """:return: The readers; their valid files are made now, with fixed seeds"""
    with tempfile.TemporaryDirectory() as folder:
        return [*_arrays(Path(folder)), *_training(Path(folder)), *_settings(), *_evaluation(Path(folder)), *_missions()]


def _saved(write: Callable[[Path], Any], path: Path) -> bytes:
    write(path)
    return path.read_bytes()


def _instances(whole: bool = False, n: int = 3) -> Instances:
    plain = UniformGenerator(6, 2)(n, np.random.default_rng(0))
    if not whole:
        return plain
    rng = np.random.default_rng(1)
    shape = (n, 6)
    return Instances.from_arrays(
        plain.depot, plain.tasks, rng.integers(1, 9, shape), rng.uniform(1, 2, (n, 2)), 2,
        np.arange(6) < np.array([[6], [4], [5]])[:n],
        rng.uniform(size=(n, 2, 2)), rng.uniform(size=(n, 2, 2)), rng.uniform(0, 0.1, shape), rng.random(shape) < 0.2,
    )  # fmt: skip


def _arrays(folder: Path) -> list[Reader]:
    files = [_saved(_instances(whole).save, folder / "a.npz") for whole in (False, True)]
    history = EvaluationHistory.empty(4, 2)
    for step in (10, 20):
        result = FixedSetResult(np.arange(4.0), np.arange(4), np.arange(4.0) + 1)
        history = history.append(step, result, np.array([1.5, 2.5]))
    evaluations = _saved(partial(history.save, n_samples=2), folder / "evaluations.npz")
    change = mutations.zip_changed(mutations.npz_member)
    return [
        Reader("instances .npz", 22, "tasks.npz", files, change, Instances.load),
        Reader("evaluations.npz", 12, "evaluations.npz", [evaluations], change, EvaluationHistory.load),
    ]


def _training(folder: Path) -> list[Reader]:
    rng = np.random.default_rng(0)
    settings = {"n_subsets": 4, "batch_size": 2}
    lesson = Lesson(_instances().with_fleet(1), th.tensor([[1, 2, 3, 0], [4, 5, 0, 0], [6, 0, 0, 0]]))
    ImitationProgress(folder, settings).save_lessons([lesson], rng)
    router = RouterPolicy(*RouterPolicy.placeholder_spaces(None), lambda _: 1e-3, **NETWORK)
    ImitationProgress(folder, settings).save_updates(3, 5, router, router.optimizer, rng)
    fresh = (router.state_dict(), router.optimizer.state_dict())

    def restore_updates(path: Path) -> None:
        optimizer = th.optim.Adam(router.parameters())
        ImitationProgress(path.parent, settings).restore_updates(router, optimizer, np.random.default_rng(0))
        router.load_state_dict(fresh[0])

    def restore_lessons(path: Path) -> None:
        ImitationProgress(path.parent, settings).restore_lessons(np.random.default_rng(0))

    record = {"epoch": 1, "level": "router", "phase": "pre-training", "n_instances": 8, "objective": 3.5, "seconds": 0.1}
    state = {"epoch": 1, "allocator": "allocator_1.zip", "router": "router_1.zip", "warm_started": True, "share": 1.0}
    state["records"] = [record, {**record, "level": "allocator", "generation_seconds": 0.1, "cpu_seconds": 0.2}]
    table = SizeTable([{"updates": 1.0, "seconds": 2.0, "U2-N6": 3.0, "score": 1.0}] * 2).text().encode()
    tensors = mutations.zip_changed(mutations.tensor_member)
    return [
        Reader("its_state.json", 8, "its_state.json", [json.dumps(state).encode()], mutations.json_changed, _read_state),
        Reader("imitation lessons", 6, "lessons_0.pt", [(folder / "lessons_0.pt").read_bytes()], tensors, restore_lessons),
        Reader("imitation updates", 3, "updates.pt", [(folder / "updates.pt").read_bytes()], tensors, restore_updates),
        Reader("size table .csv", 3, "sizes.csv", [table], mutations.lines_changed, lambda p: SizeTable.load(p, ["U2-N6"])),
        _policies(folder),
    ]  # fmt: skip


def _read_state(path: Path) -> None:
    read_state(path.parent)


def _policies(folder: Path) -> Reader:
    from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv, TaskAllocationEnv
    from sb3_uav.reinforce import REINFORCE

    files = []
    for number, (policy, env) in enumerate(((AllocatorPolicy, TaskAllocationEnv(4, 2)), (RouterPolicy, RoutePlanningEnv(4)))):
        model = REINFORCE(policy, BatchedVecEnv([lambda env=env: env] * 2), policy_kwargs=NETWORK, device="cpu", seed=0)  # type: ignore[misc]
        files.append(_saved(model.save, folder / f"{number}.zip"))
    return Reader("policy zips", 3, "model.zip", files, mutations.zip_changed(mutations.policy_member), load_policy)


def _config() -> bytes:
    router = {"algo": "reinforce", "policy": "RouterPolicy", "n_envs": 2, "policy_kwargs": NETWORK, "learning_rate": 0.001}
    its = {"router": router, "n_epochs": 1, "n_pretraining_epochs": 1, "n_intensive_epochs": 0, "n_continuous_epochs": 1}
    entry = {
        **{"policy": "sb3_uav.policies.AllocatorPolicy", "policy_kwargs": NETWORK, "n_envs": 2, "n_timesteps": 20},
        **{"instances_per_epoch": 2, "learning_rate": "lin_0.002", "n_samples": 2, "baseline": "shared", "max_grad_norm": 3.0},
        "env_kwargs": {"max_distance": 1.5},
        "callback": [
            {"sb3_uav.training.ITSCallback": its},
            {"sb3_uav.training.FixedSetEvalCallback": {"n_instances": 2, "n_samples": 2}},
        ],
    }
    return yaml.safe_dump({_ENV: entry}).encode()


def _settings() -> list[Reader]:
    from sb3_uav.registration import ensure_registered
    from sb3_uav.reinforce import REINFORCE
    from sb3_uav.zoo.configs import check_keys, check_values, plain_numbers, read_yaml
    from sb3_uav.zoo.entries import find_entry, scaled_values
    from sb3_uav.zoo.saved import read_saved

    ensure_registered(_ENV)

    def read_config(path: Path) -> None:
        found = read_yaml(path)
        name = find_entry(found, _ENV)
        entry = found.get(name)
        if not isinstance(entry, dict):
            raise ValueError(f"{path}: no entry")
        check_keys(set(entry), REINFORCE, f"{path}, {name}")
        entry = plain_numbers(entry)
        check_values(entry, f"{path}, {name}")
        scaled_values(entry, str(name), _ENV)

    saved = b"!!python/object/apply:collections.OrderedDict\n- - - env_kwargs\n    - {n_tasks: 5}\n  - - callback\n    - []\n"
    specs = [
        b"greedy-insertion:name=a", b"local-search:name='a,b'", b"kmeans-nearest", b"milp:name=x",
        b"dl-drl:allocator=a.zip,router=b.zip",
        b"pyvrp:name=\"a\"\"b\"", b"sb3:zip=model.zip",
    ]  # fmt: skip
    run = mutations.yaml_changed(_SMALL, blindly=0.1)
    return [
        Reader("YAML configs", 14, "conf.yml", [_config()], mutations.yaml_changed(), read_config),
        Reader("YAML of runs", 5, "args.yml", [saved, _config()], mutations.yaml_changed(blindly=1.0), read_saved),
        Reader("YAML configs, trained", 1, "conf.yml", [_config()], run, _train, must_name="conf.yml", may_take_long=True),
        Reader("solver specs", 6, "spec.txt", specs, mutations.bytes_changed, _make_solver, must_name=""),
    ]


def _make_solver(path: Path) -> None:
    spec = path.read_bytes().decode("utf-8", "replace")
    make_solver(spec, device="cpu", batch_size=None)


def _train(path: Path) -> None:
    """One line and the exit code 2, or a training of a few steps."""
    from sb3_uav.zoo import train

    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        code = train.main(
            ["--env", _ENV, "--conf-file", str(path), "-f", str(path.parent), "--seed", "1", "-n", "20", "--device", "cpu"]
        )
    errors = [line for line in said.getvalue().splitlines() if ": error: " in line]
    if code != 0:
        if code not in (1, 2) or len(errors) != 1:
            raise RuntimeError(f"exit code {code}, {len(errors)} lines of errors")
        raise ValueError(errors[0])


def _evaluation(folder: Path) -> list[Reader]:
    from sb3_uav.evaluation.benchmarks.best_known import read_best_known
    from sb3_uav.plots.learning_curves import _read_its_log

    instances, solver = _instances(n=2), make_solver("greedy-insertion")
    evaluate([solver], instances, folder / "run")
    files = {name: (folder / "run" / name).read_bytes() for name in ("results.csv", "schedules.jsonl", "evaluation.json")}
    # Not the time it took, so that a case is the same in every run.
    files["results.csv"] = re.sub(rb"\d+\.\d+(?=,True)", b"0.5", files["results.csv"])
    changes = {
        "results.csv": mutations.lines_changed,
        "schedules.jsonl": mutations.json_lines_changed,
        "evaluation.json": mutations.json_changed,
    }
    log = (
        b"epoch,level,phase,n_instances,objective,seconds,generation_seconds,cpu_seconds\n"
        b"1,router,pre-training,8,3.5,0.1,0.0,0.1\n1,allocator,intensive,8,3.5,0.1,0.0,0.1\n"
    )
    best = b"instance,best_known\na,12\nb,7.5\n"

    def resume(path: Path) -> None:
        evaluate([solver], instances, path.parent, resume=True)

    return [
        *(
            Reader(name, 3, name, [files[name]], change, resume, files, must_name="folder")
            for name, change in changes.items()
        ),
        Reader("best_known.csv", 4, "best.csv", [best], mutations.lines_changed, read_best_known),
        Reader("its_log.csv", 4, "its_log.csv", [log], mutations.lines_changed, _read_its_log),
    ]  # fmt: skip


def _missions() -> list[Reader]:
    from sb3_uav.web.work import do

    uploads = list(_SEEDS)

    csvs = [
        b"id,lat,lon,value,depot\nbase,47.0,8.0,1,yes\na,47.01,8.0,2,\nb,47.0,8.01,3,\n",
        b"id;x;y;service_s;must\na;1500,5;2000;3;1\nb;4000;5000;6;0\n",
    ]
    fleet = b"id,range_m,speed_mps,start_lat,start_lon,reserve_percent\nu1,6000,10,47,8,5\nu2,5000,12,47.01,8.01,0\n"
    status = b"what,id,lat,lon,remaining_m,value\nuav,u1,47.001,8.001,3000,\ndone,a,,,,\ntask,z,47.02,8.02,,5\n"
    oplib = (
        b"NAME : r\nTYPE : OP\nDIMENSION : 4\nCOST_LIMIT : 30\n"
        b"EDGE_WEIGHT_TYPE : EUC_2D\nNODE_COORD_SECTION\n1 0 0\n2 3 4\n3 6 8\n4 1 1\n"
        b"NODE_SCORE_SECTION\n1 0\n2 5\n3 7\n4 1\nDEPOT_SECTION\n1\n-1\nEOF\n"
    )
    geojson, plan, wpl, chao, mission = uploads[2], uploads[3], uploads[4], uploads[5], uploads[6]
    tasks = [("CSV", "t.csv", csvs, mutations.lines_changed), ("GeoJSON", "t.geojson", [geojson], mutations.json_changed)]
    tasks += [
        ("QGroundControl .plan", "t.plan", [plan], mutations.json_changed),
        ("QGC WPL", "t.waypoints", [wpl], mutations.lines_changed),
    ]
    tasks += [("Chao", "t.txt", [chao], mutations.lines_changed), ("OPLib", "t.oplib", [oplib], mutations.lines_changed)]

    def upload(path: Path) -> None:
        data = path.read_bytes()
        # The name of the upload is a part of the case: mostly one that fits.
        suffixes = {b"id,": 0, b"id;": 0, b'{"t': 1, b'{"f': 2, b"QGC": 3, b"PK\3": 4, b"n 4": 5}
        known = suffixes.get(data[:3]) if len(data) % 5 else None
        name = ("t.csv", "t.json", "t.plan", "t.waypoints", "t.npz", "t.txt", "t.oplib", "t")[
            sum(data[:3]) % 8 if known is None else known
        ]
        about = {"kind": "read", "what": "fleet" if data[:5] == b"id,ra" else "tasks", "max_tasks": 2000, "max_uavs": 100}
        do({**about, "name": name, "unit": None, "allow_duplicates": True}, [data], lambda *_: None)

    return [
        *(Reader(f"missions: {name}", 6, file, files, change, read_tasks) for name, file, files, change in tasks),
        Reader("missions: fleet CSV", 5, "fleet.csv", [fleet], mutations.lines_changed, read_fleet),
        Reader("missions: status CSV", 5, "status.csv", [status], mutations.lines_changed, read_status),
        Reader("missions: mission.json", 6, "mission.json", [_mission()], mutations.json_changed, load_plan),
        Reader("web uploads", 10, "t.bin", [*uploads, *csvs, fleet, mission], mutations.bytes_changed, upload, must_name="t"),
    ]


def _mission() -> bytes:
    from sb3_uav.missions.fleet import Fleet
    from sb3_uav.missions.tasks import TaskList

    points = np.random.default_rng(0).uniform(0, 1000, (5, 2))
    tasks = TaskList.of("abcde", points, "plane", np.arange(1.0, 6.0), depot=(500.0, 500.0))
    plan = plan_to_json(solve(tasks, Fleet.of_equal(2, 1500.0), "greedy-insertion", 0.01))
    return json.dumps({**plan, "seconds": 0.5}).encode()
