"""
Training speed of both levels: instances and episodes per second of an epoch, against the paper's method and RL4CO.

An instance is one problem that contributes to one update; an episode is one sampled solution of it that enters the gradient.
Greedy rollouts of a baseline do not count as episodes. Our shipped settings sample 8 episodes of every instance from one
encoding, the others one, so both rates and both ratios are printed.

``default``
    The settings of ``TaskAllocation-Universal-v0`` in ``zoo_configs/reinforce.yml``: 8 samples and their mean as the baseline.
``paper``
    The settings of ``zoo_configs/paper.yml``: width 128, 3 layers, 8 heads, batch normalization, one sample and
    one greedy rollout of the baseline's policy. As in the paper, the subsets of all UAVs are padded to one size before tours
    are planned. The paper pads them to the number of tasks of the whole instance, N, by repeating tasks: decoding masks the
    repeats, but the encoder sees them, as nodes like any other. Here they are padded to the largest subset of the batch, and
    neither encoder nor decoder sees the padding, so that the router has fewer nodes to encode: this favors the paper. Its
    router is the attention model: the like of ``rl4co-paper``.
``plain``
    The router as in ``paper``, but with layers, width, heads and normalization of ``default``: the like of ``rl4co-default``.
``rl4co-paper``, ``rl4co-default``
    RL4CO's ``AttentionModelPolicy`` with the layers, width, heads and normalization of these two routers, trained by RL4CO's
    trainer and ``REINFORCE`` with its rollout baseline on its ``OPEnv``: prizes 1, the same maximum length, float32, without
    logger and checkpoints.

All have the same number of tasks and of instances per update. The router learns on whole instances, one UAV having all tasks,
as in pre-training. An epoch is drawing instances, episodes, baseline and updates; validation and the test whether the policy
of the baseline is to be replaced are left out everywhere, and so is the first epoch of the rollout baselines, which does
without rollouts. The networks are fresh, and so is the router from which the allocator's reward comes, one with the network
of the same settings. ``return`` (tasks visited per episode) tells how long the router's episodes are: RL4CO lets a tour end
early, and our default router starts with a preference for near tasks, so that its episodes have two to three times the steps
of the others, which these reach only after some training. With a ``--max-distance`` beyond all tours, say 1000, all episodes
of ours have one step for every task.

The competitors take turns, and ratios are those of medians over the rounds, once per second of the clock and once per second
of CPU time, which other programs on the machine disturb less. Under "rounds" are the least and the largest ratio of episodes
per CPU second in one round.

RL4CO has an environment of its own, whose Python is named by ``--rl4co``. A recipe that shares this environment's torch::

    python -m venv rl4co
    python -c "import site; print(site.getsitepackages()[0])" > rl4co/lib/python3.11/site-packages/shared.pth
    rl4co/bin/pip install --no-deps rl4co==0.7.0 tensordict==0.13.0 torchrl==0.13.3 lightning==2.6.6 \\
        pytorch-lightning==2.6.6 lightning-utilities==0.15.3 torchmetrics==1.9.0 einops==0.8.2 hydra-core==1.3.2 \\
        hydra-colorlog==1.2.0 omegaconf==2.3.0 antlr4-python3-runtime==4.9.3 pyrootutils==1.0.4 robust-downloader==0.0.2 \\
        pyvers==0.2.3 orjson==3.13.0 importlib_metadata==10.2.0 zipp==4.1.2

    python benchmarks/training_throughput.py --rl4co rl4co/bin/python --out throughput.csv
"""

from __future__ import annotations

import argparse
import csv
import inspect
import io
import json
import subprocess
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, Protocol

import torch as th
from _rl4co_server import Clock, Measurement

if TYPE_CHECKING:
    from sb3_uav.envs.routing import Router
    from sb3_uav.policies import RouterPolicy

SERVER = Path(__file__).resolve().with_name("_rl4co_server.py")
CONFIGS = Path(__file__).parents[1] / "zoo_configs"
# File and entry.
ENTRIES = {"default": ("reinforce.yml", "TaskAllocation-Universal-v0"), "paper": ("paper.yml", "TaskAllocation-U4-N80-v0")}
SHAPE = ("embed_dim", "n_layers", "n_heads", "ff_dim", "normalization")
# Compared competitors, by level.
PAIRS = {
    "allocator": [("default", "paper")],
    "router": [
        ("default", "paper"),
        ("paper", "rl4co-paper"),
        ("plain", "rl4co-default"),
        ("default", "rl4co-default"),
        ("default", "rl4co-paper"),
    ],
}


class Competitor(Protocol):
    """A training that can be measured."""

    # Episodes per instance.
    n_samples: int

    def measure(self, seconds: float) -> Measurement:
        """
        :param seconds: Minimum duration; whole epochs are trained
        :return: The measurement
        """
        ...


# -------------------------------------------------------------------------------------------------------------- ours


def settings_of(name: str) -> dict[str, dict[str, Any]]:
    """
    :param name: ``"default"``, ``"paper"`` or ``"plain"``
    :return: Arguments of ``REINFORCE``, by level
    """
    import yaml

    from sb3_uav.reinforce import REINFORCE

    file, env_id = ENTRIES["default" if name == "default" else "paper"]
    allocator = yaml.safe_load((CONFIGS / file).read_text(encoding="utf-8"))[env_id]
    its = next(callback for callback in allocator["callback"] if "sb3_uav.training.ITSCallback" in callback)
    router = its["sb3_uav.training.ITSCallback"]["router"]
    known = inspect.signature(REINFORCE).parameters.keys() - {"policy", "env"}
    settings = {
        level: {key: value for key, value in entry.items() if key in known}
        for level, entry in (("allocator", allocator), ("router", router))
    }
    if name == "plain":
        settings["router"]["policy_kwargs"] = {"preset": "paper", **router_shape("default")}
    for kwargs in settings.values():
        if kwargs["baseline"] == "rollout":
            kwargs["baseline_kwargs"] = {"warmup_epochs": 0}
    return settings


def router_shape(name: str) -> dict[str, Any]:
    """
    :param name: ``"default"`` or ``"paper"``
    :return: Layers, width, heads and normalization of that router
    """
    from sb3_uav.policies.settings import NetworkSettings

    policy_kwargs = dict(settings_of(name)["router"]["policy_kwargs"])
    preset = policy_kwargs.pop("preset", "default")
    network = NetworkSettings.of(policy_kwargs, preset)
    return {key: getattr(network, key) for key in SHAPE}


def padded_plan(router: RouterPolicy) -> Router:
    """
    :param router: A router
    :return: A planner that takes all subsets at once, padded to the largest; the paper's are padded to the whole instance
    """
    return lambda subsets: router.decode_episodes(subsets)[:, 0]


class Ours:
    """
    ``REINFORCE`` of this package.

    :param level: ``"allocator"`` or ``"router"``
    :param name: ``"default"``, ``"paper"`` or ``"plain"``
    :param args: Arguments of the command line
    """

    def __init__(self, level: str, name: str, args: argparse.Namespace) -> None:
        from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv, TaskAllocationEnv
        from sb3_uav.policies import AllocatorPolicy, RouterPolicy
        from sb3_uav.reinforce import REINFORCE

        th.set_num_threads(args.num_threads)
        settings = settings_of(name)
        policy: Any = AllocatorPolicy if level == "allocator" else RouterPolicy
        route_env = RoutePlanningEnv(args.n_tasks, args.max_distance)
        th.manual_seed(0)
        router = RouterPolicy(
            route_env.observation_space, route_env.action_space, lambda _: 0.0, **settings["router"]["policy_kwargs"]
        )

        def make_env() -> Any:
            if level == "router":
                return route_env
            plan = padded_plan(router) if name == "paper" else router.plan
            return TaskAllocationEnv(args.n_tasks, args.n_uavs, args.max_distance, router=plan)

        env = BatchedVecEnv([make_env] * args.batch_size)
        self.model = REINFORCE(policy, env, device="cpu", seed=0, **settings[level])
        self.n_samples = self.model.n_samples
        self.epoch_size = args.epoch_batches * args.batch_size
        self.model.learn_instances(self.epoch_size)

    def measure(self, seconds: float) -> Measurement:
        before, clock = self.model.n_instances, Clock()
        self.model.learn_instances(self.epoch_size)
        while (elapsed := clock.read())[0] < seconds:
            self.model.learn_instances(self.epoch_size)
        assert self.model.ep_info_buffer is not None
        returns = [info["r"] for info in self.model.ep_info_buffer]
        return Measurement(self.model.n_instances - before, *elapsed, sum(returns) / len(returns))


# -------------------------------------------------------------------------------------------------------------- RL4CO


class RL4CO:
    """
    RL4CO's attention model, in a process of its own.

    :param shape: Layers, width, heads and normalization
    :param args: Arguments of the command line
    :raises RuntimeError: If the process ends early
    """

    n_samples = 1

    def __init__(self, shape: dict[str, Any], args: argparse.Namespace) -> None:
        keys = ("n_tasks", "max_distance", "batch_size", "epoch_batches", "num_threads")
        settings = {key: getattr(args, key) for key in keys}
        command = [args.rl4co, str(SERVER), json.dumps({**settings, **shape})]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        # It reports the end of its first epoch, which has no rollouts.
        self._receive()

    def _receive(self) -> Any:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self.process.args!r} ended with {self.process.wait()}; see what it printed above.")
        return json.loads(line)

    def measure(self, seconds: float) -> Measurement:
        assert self.process.stdin is not None
        print(seconds, file=self.process.stdin, flush=True)
        return Measurement(*self._receive())

    def close(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.communicate()


# -------------------------------------------------------------------------------------------------------------- report


def report(level: str, n_samples: dict[str, int], measured: dict[str, list[Measurement]]) -> None:
    """
    Print rates and ratios of one level.

    :param level: ``"allocator"`` or ``"router"``
    :param n_samples: Episodes per instance, by competitor
    :param measured: The rounds of every competitor
    """
    rates = {name: [row.n_instances / row.seconds for row in rows] for name, rows in measured.items()}
    cpu_rates = {name: [row.n_instances / row.cpu_seconds for row in rows] for name, rows in measured.items()}
    print(f"\n{level:28} {'instances/s':>12} {'episodes/s':>12} {'episodes/CPU s':>15} {'return':>8}")
    for name, rows in measured.items():
        wall, cpu, samples = median(rates[name]), median(cpu_rates[name]), n_samples[name]
        mean_return = median(row.mean_return for row in rows)
        print(f"{name:28} {wall:12.2f} {samples * wall:12.2f} {samples * cpu:15.2f} {mean_return:8.1f}")
    print(f"\n{'ratio of medians':28} {'instances':>12} {'per CPU s':>12} {'episodes':>12} {'per CPU s':>12} {'rounds':>15}")
    for first, second in PAIRS[level]:
        if first not in measured or second not in measured:
            continue
        factor = n_samples[first] / n_samples[second]
        wall = median(rates[first]) / median(rates[second])
        cpu = median(cpu_rates[first]) / median(cpu_rates[second])
        rounds = [factor * a / b for a, b in zip(cpu_rates[first], cpu_rates[second], strict=True)]
        print(
            f"{first + ' / ' + second:28} {wall:11.2f}x {cpu:11.2f}x {factor * wall:11.2f}x {factor * cpu:11.2f}x "
            f"{f'{min(rounds):.2f} to {max(rounds):.2f}':>15}"
        )


def to_csv(rows: list[dict[str, Any]]) -> str:
    """
    :param rows: Measurements
    :return: The rows as CSV
    """
    stream = io.StringIO()
    writer = csv.DictWriter(stream, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def compete(level: str, args: argparse.Namespace) -> list[dict[str, Any]]:
    """
    :param level: ``"allocator"`` or ``"router"``
    :param args: Arguments of the command line
    :return: Rows of the CSV
    """
    with ExitStack() as stack:
        competitors: dict[str, Competitor] = {}
        for name in sorted({name for pair in PAIRS[level] for name in pair}):
            if not name.startswith("rl4co-"):
                competitors[name] = Ours(level, name, args)
            elif args.rl4co is not None:
                competitors[name] = rl4co = RL4CO(router_shape(name.removeprefix("rl4co-")), args)
                stack.callback(rl4co.close)
        measured: dict[str, list[Measurement]] = {name: [] for name in competitors}
        for _ in range(args.rounds):
            for name, competitor in competitors.items():
                measured[name].append(competitor.measure(args.seconds))
    report(level, {name: competitor.n_samples for name, competitor in competitors.items()}, measured)
    return [
        {
            "level": level,
            "competitor": name,
            "n_tasks": args.n_tasks,
            "n_uavs": args.n_uavs if level == "allocator" else 1,
            "max_distance": args.max_distance,
            "batch_size": args.batch_size,
            "round": number,
            "n_episodes": row.n_instances * competitors[name].n_samples,
            **row._asdict(),
        }
        for name, rows in measured.items()
        for number, row in enumerate(rows, start=1)
    ]


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--level", choices=sorted(PAIRS), nargs="+", default=sorted(PAIRS))
    parser.add_argument("--n-tasks", type=int, default=100)
    parser.add_argument("--n-uavs", type=int, default=4)
    parser.add_argument("--max-distance", type=float, default=2.0)
    parser.add_argument("--batch-size", type=int, default=64, help="instances per update")
    parser.add_argument("--epoch-batches", type=int, default=4, help="updates per epoch")
    parser.add_argument("--seconds", type=float, default=10.0, help="minimum duration of a measurement")
    parser.add_argument("--rounds", type=int, default=3, help="measurements of every competitor")
    parser.add_argument("--num-threads", type=int, default=1)
    parser.add_argument("--rl4co", metavar="PYTHON", help="Python of an environment with RL4CO; without it, RL4CO is left out")
    parser.add_argument("--out", type=Path, metavar="CSV", help="output file of the measurements")
    args = parser.parse_args(arguments)
    print(
        f"N = {args.n_tasks}, V = {args.n_uavs}, D = {args.max_distance:g}, batches of {args.batch_size}, "
        f"{args.rounds} rounds of {args.seconds:g} s, {args.num_threads} threads, torch {th.__version__}"
    )
    rows = [row for level in args.level for row in compete(level, args)]
    if args.out is not None:
        from sb3_uav.common.files import write_atomically

        write_atomically(args.out, to_csv(rows))


if __name__ == "__main__":
    main()
