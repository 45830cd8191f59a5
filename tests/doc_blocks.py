"""
The code blocks of the pages, and how tests run them: as they stand, or smaller by ``RULES``; without the lines of ``NOT_RUN``.

A page's blocks run in their order, in one folder. Python blocks share their variables; every command line has a process of its
own. A block whose first line is the comment ``# NAME.py`` or ``# NAME.yml`` is also the file of that name for those after it.
YAML is trained: whole files by their entries, parts of an entry as parts of a tiny one (by the algorithm NAME, if it is one).
"""

from __future__ import annotations

import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).parents[1]
# Pages whose blocks have a test of their own.
TESTED_ELSEWHERE = {
    "docs/zoo.md": "test_zoo_docs.py",
    "docs/serve.md": "test_web_api.py",
    "docs/foreign_environments.md": "test_masked_attention_in_sb3.py",
}
PAGES = sorted(
    path.relative_to(ROOT).as_posix()
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md"), *ROOT.glob("sb3_uav/**/*.md"))
    if path.relative_to(ROOT).as_posix() not in TESTED_ELSEWHERE
)
CODE, NO_CODE = {"python", "bash", "sh", "yaml"}, {"", "text", "csv", "json", "bibtex"}


class Rule(NamedTuple):
    """
    Makes blocks smaller; every rule must change a block.

    :param page: Pages, as a pattern of file names
    :param before: Regular expression of what stands in a block, whose continued lines are joined
    :param after: What the tests run in its place
    """

    page: str
    before: str
    after: str


class NotRun(NamedTuple):
    """
    Lines that the tests leave out; every entry must leave out one.

    :param page: Pages, as a pattern of file names
    :param line: Regular expression of the beginning of a line, continued lines joined
    :param reason: Why they cannot run, not even smaller
    """

    page: str
    line: str
    reason: str


NOT_RUN = [
    NotRun("README.md", r"pip install -c", "it installs packages into the environment of the tests"),
    NotRun("docs/getting_started.md", r"pip install -c", "it installs packages into the environment of the tests"),
    NotRun("docs/from_rl4co.md", r"# RL4CO\n(?s:.*)", "RL4CO is no dependency of ours, and is not installed"),
    NotRun("CONTRIBUTING.md", r"make install", "it creates an environment and installs packages"),
    NotRun("docs/distributed.md", r"OMP_NUM_THREADS=1 torchrun --nnodes 2", "it waits for a second machine"),
]

_NETWORK = dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=8)
_SMALL = "--conf-file small/{}.yml -n 1280 --num-threads 1"
RULES = [
    # A server, which never ends.
    Rule("*", r"tensorboard --logdir (\S+)", r"tensorboard --logdir \1 --inspect"),
    Rule("README.md", r"sb3-uav serve", "sb3-uav serve --help"),
    Rule("README.md", r"(sb3-uav solve .*) -o", r"\1 --time-limit 1 -o"),
    # Smaller data, networks and budgets.
    Rule("README.md", r"rand\(16, ", "rand(2, "),
    Rule("README.md", r"n_envs=64", "n_envs=4"),
    Rule("README.md", r"instances_per_epoch=2560", "instances_per_epoch=8"),
    Rule("README.md", r"n_epochs=10", "n_epochs=1"),
    Rule("README.md", r"(sb3-uav train .*?-U4-N80-v0)", rf"\1 {_SMALL.format('reinforce')}"),
    Rule("README.md", r"allocator_7\.zip", "allocator_1.zip"),
    Rule("README.md", r"-f logs\n", "-f logs --no-render -n 80\n"),
    Rule("README.md", r"--samples 128", "--samples 4"),
    Rule("docs/training.md", r"n_envs=64", "n_envs=4"),
    Rule("docs/training.md", r"(sb3-uav train .*?-U4-N80-v0)", rf"\1 {_SMALL.format('reinforce')}"),
    Rule("docs/training.md", r"batch_size=640", "batch_size=160"),
    Rule("docs/training.md", r"300_000", "320"),
    Rule("docs/training.md", r"n_envs: 64", "n_envs: 4"),
    Rule("docs/training.md", r"n_epochs: 10", "n_epochs: 2"),
    Rule("docs/training.md", r"zoo_configs/ppo\.yml", "small/ppo.yml -n 320"),
    Rule("docs/training.md", r"-f logs --no-render", "-f logs --no-render -n 40"),
    Rule("docs/policies.md", r'-U3-N20-v0"\)', f'-U3-N20-v0", policy_kwargs={_NETWORK})'),
    Rule("docs/tensorboard.md", r"(-U3-N20-v0) -tb", rf"\1 {_SMALL.format('reinforce')} -tb"),
    Rule("docs/fine_tuning.md", r"n_envs=16", "n_envs=2"),
    Rule("docs/fine_tuning.md", r"n_tasks=60", "n_tasks=12"),
    Rule("docs/fine_tuning.md", r"learn\((100|50)_000\)", "learn(80)"),
    Rule("docs/fine_tuning.md", r"n_epochs: 10", "n_epochs: 1"),
    Rule("docs/fine_tuning.md", r"--epochs 29", "--epochs 1 --instances-per-epoch 16 --held-out 3"),
    Rule("docs/fine_tuning.md", r"--held-out 96", "--held-out 4"),
    Rule("docs/fine_tuning.md", r"(sb3-uav train .*) -i", rf"\1 {_SMALL.format('reinforce')} -i"),
    Rule(
        "docs/distributed.md",
        r"(--env TaskAllocation-U4-N80-v0)",
        r"\1 --conf-file small/reinforce.yml -n 320 --num-threads 1",
    ),
    Rule("docs/sharding.md", r"range\(10\)", "range(2)"),
    Rule("docs/sharding.md", r"\(1000,", "(3,"),
    Rule("docs/sharding.md", r"-total-trials 100", "-total-trials 1 --conf-file small/reinforce.yml -n 320 --eval-episodes 2"),
    Rule("docs/index.md", r"(sb3-uav solve .*) -o", r"\1 --time-limit 1 -o"),
    Rule("docs/getting_started.md", r"(sb3-uav solve .*) -o", r"\1 --time-limit 1 -o"),
    Rule("docs/getting_started.md", r"random\(\(16, ", "random((2, "),
    Rule("docs/getting_started.md", r"(sb3-uav train .*?-U3-N20-v0)", rf"\1 {_SMALL.format('reinforce')}"),
    Rule("docs/own_*.md", r"n_envs=16", "n_envs=2"),
    Rule("docs/own_*.md", r"learn\(\d+_000\)", "learn(80)"),
    Rule("docs/own_distribution.md", r"\(64, np", "(4, np"),
    Rule("docs/gpu.md", r"n_envs=64", "n_envs=2"),
    Rule("docs/gpu.md", r"learn\(100_000\)", "learn(80)"),
    Rule("docs/freezing.md", r"=4_000", "=512"),
    Rule("docs/freezing.md", r"=2_000", "=256"),
    Rule("docs/freezing.md", r"20_000", "1024"),
    Rule("docs/from_rl4co.md", r"n_envs=64", "n_envs=2"),
    Rule("docs/from_rl4co.md", r"learn\(100_000\)", "learn(80)"),
    Rule("docs/from_pyvrp.md", r"MaxRuntime\(1\)", "MaxRuntime(0.2)"),
    Rule("docs/from_pyvrp.md", r"time_limit=1", "time_limit=0.2"),
    Rule("docs/from_rl_zoo3.md", r"zoo_configs/ppo\.yml", "small/ppo.yml -n 320"),
    Rule("docs/from_rl_zoo3.md", r"(sb3-uav train --algo ppo .*-N20-v0)", r"\1 --conf-file small/ppo.yml -n 320"),
    Rule("docs/from_rl_zoo3.md", r"n_envs: 64", "n_envs: 4"),
    Rule("docs/from_rl_zoo3.md", r"n_epochs: 10", "n_epochs: 2"),
    Rule("docs/from_rl_zoo3.md", r"instances_per_epoch: 1280", "instances_per_epoch: 8"),
    # The files beside the tests have other names.
    Rule("docs/benchmarks.md", r"p7\.\*", "a1.*"),
    Rule("docs/benchmarks.md", r"--time-limits 0\.1 1 10 --jobs 2", "--time-limits 0.02 0.05"),
    Rule("docs/missions.md", r"(sb3-uav solve .*) -o", r"\1 --time-limit 1 -o"),
    Rule("docs/missions.md", r"time_limit=10", "time_limit=1"),
    Rule("docs/results/*", r"U4-N80\.npz U6-N80\.npz \.\.\. \S+", "U4-N80.npz"),
    Rule("docs/results/*", r"U4-N500\.npz U6-N200\.npz", "U4-N80.npz"),
    Rule("docs/results/*", r"(time_limit|polish)=10?\b", r"\1=0.2"),
    Rule("docs/results/*", r"--time-limit [\d. ]+", "--time-limit 0.1 0.2 "),
    Rule("docs/results/README.md", r"reproduce all --scale cpu", "reproduce table1 --scale smoke --no-training"),
    Rule("docs/comparison/*/report.md", r"-n \d+", "-n 320 --n-instances 2 --samples 2 --router-subsets 16 --jobs 2"),
    Rule("docs/comparison/*/report.md", r"--eval-freq \d+", "--eval-freq 160"),
    Rule("docs/comparison/*/report.md", r"--seeds [\d ]+", "--seeds 0 "),
    Rule("docs/comparison/*/report.md", r"(sb3-uav compare (?!.*--variants).*)", r"\1 --variants small/variants.yml"),
    Rule("docs/comparison/router/report.md", r" --report-only", ""),
    Rule("docs/comparison/*_long/report.md", r"--variants long\.yml", "--variants small/reinforce_alone.yml"),
    Rule("docs/comparison/*_ppo/report.md", r"--variants ppo\.yml", "--variants small/ppo_alone.yml"),
    Rule("docs/comparison/*_*/report.md", r"--router allocator/router\.zip", "--router small/router.zip"),
    Rule(
        "sb3_uav/pretrained/*/README.md",
        r"(--env TaskAllocation-(?:Universal|World)-v0)",
        rf"\1 {_SMALL.format('reinforce')}",
    ),
]

# What in the YAMLs is made smaller for the rules with ``small/``, wherever it stands.
_SMALLER: dict[str, Any] = dict(
    n_envs=4,
    n_steps=20,
    batch_size=40,
    n_samples=2,
    n_instances=2,
    # That of a rollout baseline is tested on 10,000 instances.
    baseline="exponential",
    instances_per_epoch=8,
    router_instances_per_epoch=8,
    n_epochs=2,
    n_pretraining_epochs=1,
    n_intensive_epochs=0,
    n_continuous_epochs=1,
    n_subsets=8,
    n_updates=2,
    sizes=[[2, 5, 2]],
    policy_kwargs=_NETWORK,
)


class Block(NamedTuple):
    """
    A code block.

    :param page: The page
    :param number: Its number there, from 1
    :param language: ``python``, ``bash``, ``sh`` or ``yaml``
    :param text: What the tests run: continued lines joined, rules applied
    """

    page: str
    number: int
    language: str
    text: str


def code_blocks(page: str) -> list[tuple[str, str]]:
    """Language and text of every block of a page that is code."""
    text = (ROOT / page).read_text(encoding="utf-8")
    found = re.findall(r"^ *```([^\n`]*)\n(.*?)^ *```", text, flags=re.DOTALL | re.MULTILINE)
    unknown = {language for language, _ in found} - CODE - NO_CODE
    assert not unknown, f"{page}: blocks in {sorted(unknown)}; add the language to CODE or NO_CODE of {Path(__file__).name}"
    return [(language, block.replace("\\\n", " ")) for language, block in found if language in CODE]


def smaller(page: str, text: str, used: set[Any] | None = None) -> str:
    """
    :param page: A page
    :param text: A block of it
    :param used: Receives the rules that changed the block
    :return: The block, changed by the rules
    """
    for rule in RULES:
        if fnmatch(page, rule.page):
            text, n_changes = re.subn(rule.before, rule.after, text)
            if n_changes > 0 and used is not None:
                used.add(rule)
    return text


def without_lines(page: str, text: str, used: set[Any] | None = None) -> str:
    """
    :param page: A page
    :param text: A block of it
    :param used: Receives the entries of ``NOT_RUN`` that left out a line
    :return: The block without these lines
    """
    for entry in NOT_RUN:
        if fnmatch(page, entry.page):
            text, n_changes = re.subn(rf"^{entry.line}.*\n?", "", text, flags=re.MULTILINE)
            if n_changes > 0 and used is not None:
                used.add(entry)
    return text


def blocks_to_run(page: str) -> Iterator[Block]:
    """The blocks of a page that are not left out as a whole."""
    for number, (language, text) in enumerate(code_blocks(page), start=1):
        left = smaller(page, without_lines(page, text))
        if left.strip():
            yield Block(page, number, language, left)


# ------------------------------------------------------------------------------------------------------ files


def prepare(folder: Path, page: str) -> None:
    """Put into the folder what the blocks of a page find there: the checkout's files, and the small ones that rules name."""
    import yaml

    for name in ("zoo_configs", "examples", "benchmarks"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("Makefile", "constraints.txt", "setup.cfg"):
        shutil.copy(ROOT / name, folder)
    small = folder / "small"
    small.mkdir()
    for path in (ROOT / "zoo_configs").glob("*.yml"):
        entries = yaml.safe_load(path.read_text(encoding="utf-8"))
        (small / path.name).write_text(yaml.safe_dump(_shrunk(entries)), encoding="utf-8")
    if page.startswith("docs/comparison/"):
        _prepare_comparison(small)
    if page == "docs/benchmarks.md":
        shutil.copytree(ROOT / "tests" / "bench_files", folder / "top")
    if page.startswith("docs/results/"):
        from sb3_uav.envs import UniformGenerator

        UniformGenerator(6, 4)(2, np.random.default_rng(0)).save(folder / "U4-N80.npz")


def _shrunk(entry: Any) -> Any:
    if isinstance(entry, dict):
        smaller = {key: _SMALLER.get(key, _shrunk(value)) for key, value in entry.items()}
        kwargs = entry.get("policy_kwargs")
        if isinstance(kwargs, dict) and "preset" in kwargs:
            # Other networks may refuse the environment.
            smaller["policy_kwargs"] = {**_NETWORK, "preset": kwargs["preset"]}
        return smaller
    return [_shrunk(value) for value in entry] if isinstance(entry, list) else entry


def _prepare_comparison(small: Path) -> None:
    """Variants of the names that the reports have, small, and a router that has learned nothing."""
    import yaml

    from sb3_uav.envs import BatchedVecEnv, RoutePlanningEnv
    from sb3_uav.policies import RouterPolicy
    from sb3_uav.reinforce import REINFORCE

    ppo = dict(n_envs=4, n_steps=20, batch_size=40, n_epochs=1, policy_kwargs=_NETWORK)
    reinforce = dict(algo="reinforce", n_envs=4, n_samples=2, policy_kwargs=_NETWORK)
    variants: dict[str, dict[str, Any]] = {
        "PPO": dict(algo="ppo", **ppo),
        "MaskablePPO": dict(algo="ppo_mask", **ppo),
        "REINFORCE, shared baseline": dict(reinforce, baseline="shared"),
        "REINFORCE, rollout baseline": dict(reinforce, baseline="rollout"),
    }
    for name, chosen in (
        ("variants", list(variants)),
        ("ppo_alone", ["PPO"]),
        ("reinforce_alone", ["REINFORCE, shared baseline"]),
    ):
        text = yaml.safe_dump({variant: variants[variant] for variant in chosen}, sort_keys=False)
        (small / f"{name}.yml").write_text(text, encoding="utf-8")
    env: Any = BatchedVecEnv([lambda: RoutePlanningEnv(5)] * 2)
    policy: Any = RouterPolicy
    REINFORCE(policy, env, policy_kwargs=_NETWORK, device="cpu").save(small / "router.zip")


# ------------------------------------------------------------------------------------------------------ running


def named_file(block: Block) -> str | None:
    """The file that a block says it is."""
    match = re.match(r"#\s*([\w./-]+\.(?:py|ya?ml))\s*\n", block.text)
    return None if match is None else match[1]


def command_lines(text: str) -> Iterator[str]:
    """The commands of a block; all of it, if a command goes over several lines."""
    if re.search(r"^\s*(for|if|while|case)\b|<<", text, flags=re.MULTILINE):
        yield text
        return
    yield from (line for line in text.splitlines() if shlex.split(line, comments=True))


def run_command_line(line: str) -> None:
    """Run a command line in this process, where it is one of Python's, otherwise in a shell; ends the process."""
    words = shlex.split(line, comments=True)
    while "=" in words[0]:
        name, _, value = words.pop(0).partition("=")
        os.environ[name] = value
    sys.path.insert(0, os.getcwd())
    if not re.search(r"[|&;<>$`]", line) and words[0] == "sb3-uav":
        from sb3_uav.cli import main as cli

        sys.argv = words
        sys.exit(cli.main(words[1:]))
    if not re.search(r"[|&;<>$`]", line) and words[:2] == ["python", "-m"]:
        sys.argv = words[2:]
        runpy.run_module(words[2], run_name="__main__", alter_sys=True)
    elif not re.search(r"[|&;<>$`]", line) and words[0] == "python":
        sys.argv = words[1:]
        sys.path.insert(0, str(Path(words[1]).parent))
        runpy.run_path(words[1], run_name="__main__")
    else:
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
        done = subprocess.run(["bash", "-euc", line], env={**os.environ, "PATH": path}, capture_output=True, text=True)
        print(done.stdout)
        print(done.stderr, file=sys.stderr)
        sys.exit(done.returncode)


def train_yaml(text: str, algo: str) -> None:
    """Train each entry of a file, or a tiny entry with these parts."""
    import yaml
    from tiny_zoo import ENV, entry

    from sb3_uav.zoo import train

    given = yaml.safe_load(text)
    assert isinstance(given, dict), f"found {given!r:.80}, neither entries nor parts of one"
    ids = [key for key in given if re.search(r"-v\d+$", str(key))]
    entries = given if ids else {ENV: entry(**given)}
    Path("block.yml").write_text(yaml.safe_dump(entries), encoding="utf-8")
    for env in ids or [ENV]:
        flags = ["--algo", algo, "--env", env, "--conf-file", "block.yml", "-f", "logs_of_block", "-n", "480"]
        code = train.main([*flags, "--eval-freq", "-1", "--num-threads", "1"])
        assert code == 0, f"{env}: exit code {code}"
