"""The model card of a pushed agent."""

from __future__ import annotations

from typing import Any, NamedTuple

import yaml

from sb3_uav.zoo.tuning import problem_env_class

_UNPICKLING = """\
> **Only replay agents whose owner you trust.** SB3's zips hold pickles: `REINFORCE.load`, like `load` of every SB3 algorithm,
> and `enjoy --trust` run whatever code is in them. `sb3-uav enjoy` without it, `sb3-uav evaluate` and
> `sb3_uav.policies.loading.load_policy` do not: they read the plain JSON and the tensors only.
"""


class Results(NamedTuple):
    """
    What the agent achieved on new instances.

    :param mean_reward: Mean return
    :param std_reward: Standard deviation of the returns
    :param success_rate: Share of episodes that visited every task that can count; None if that is undefined
    :param n_episodes: Number of episodes
    :param deterministic: Whether the most likely actions were played
    :param seed: Seed of the environment
    """

    mean_reward: float
    std_reward: float
    success_rate: float | None
    n_episodes: int
    deterministic: bool
    seed: int


class Card(NamedTuple):
    """
    :param algo: rl_zoo3's name of the algorithm
    :param class_name: Name of its class
    :param env_id: Id of the environment
    :param env_kwargs: Arguments of the environment
    :param organization: Owner of the repository
    :param repo_name: Its name; that of rl_zoo3 when None
    :param model_file: Name of the agent's zip
    :param has_router: Whether ``router.zip`` lies beside it
    :param has_video: Whether ``replay.mp4`` does
    :param hyperparams: The YAML entry of the training
    :param n_timesteps: Environment steps of its training
    :param results: What it achieved
    :param version: Version of sb3_uav
    """

    algo: str
    class_name: str
    env_id: str
    env_kwargs: dict[str, Any]
    organization: str
    repo_name: str | None
    model_file: str
    has_router: bool
    has_video: bool
    hyperparams: dict[str, Any]
    n_timesteps: int
    results: Results
    version: str

    def text(self) -> str:
        """:return: The card as Markdown, with the metadata of the Hugging Face Hub in front"""
        from huggingface_hub import EvalResult, ModelCardData

        value = f"{self.results.mean_reward:.2f} +/- {self.results.std_reward:.2f}"
        result = EvalResult(
            task_type="reinforcement-learning",
            task_name="reinforcement-learning",
            dataset_type=self.env_id,
            dataset_name=self.env_id,
            metric_type="mean_reward",
            metric_name="mean_reward",
            metric_value=value,
        )
        tags = [self.env_id, "deep-reinforcement-learning", "reinforcement-learning", "stable-baselines3", "sb3_uav"]
        data = ModelCardData(library_name="stable-baselines3", tags=tags, model_name=self.class_name, eval_results=[result])
        return f"---\n{data.to_yaml()}\n---\n\n{self._body()}"

    def _body(self) -> str:
        what = "A pair of networks" if self.has_router else "A network"
        purpose = " for the task scheduling of UAV fleets" if problem_env_class(self.env_id) else ""
        parts = [
            f"# {self.class_name} on {self.env_id}",
            f"{what}{purpose}, trained for {self.n_timesteps:,} environment steps with [Stable-Baselines3]"
            f"(https://github.com/DLR-RM/stable-baselines3) and sb3_uav {self.version}.",
            self._files(),
            self._results(),
            "## Use",
            _UNPICKLING,
            self._commands(),
            "## Training",
            f"```yaml\n{_dump({self.env_id: self.hyperparams})}```",
        ]
        if self.env_kwargs:
            parts += ["The environment was made with:", f"```yaml\n{_dump(self.env_kwargs)}```"]
        return "\n\n".join(part.rstrip("\n") for part in parts) + "\n"

    def _files(self) -> str:
        lines = ["| file | content |", "| --- | --- |"]
        level = "allocator, which gives each task to a UAV" if self.has_router else "policy"
        lines.append(f"| `{self.model_file}` | the {level} |")
        if self.has_router:
            lines.append("| `router.zip` | the router, which plans the tours that give the allocator's rewards |")
        lines.append("| `config.yml`, `args.yml`, `env_kwargs.yml` | settings of the training |")
        lines.append("| `train_eval_metrics.zip` | monitor files, evaluations and the log of epochs |")
        if self.has_video:
            lines.append("| `replay.mp4` | an episode |")
        return "\n".join(lines)

    def _results(self) -> str:
        found = self.results
        mode = "most likely actions" if found.deterministic else "sampled actions"
        lines = [
            "## Results",
            "",
            f"Mean return of {found.n_episodes} episodes ({mode}, environment seed {found.seed}): "
            f"**{found.mean_reward:.2f}** (standard deviation {found.std_reward:.2f}).",
        ]
        if found.success_rate is not None:
            lines.append(
                f"Every task within reach was visited in {found.success_rate:.0%} of them; on most instances no fleet can."
            )
        return "\n".join(lines)

    def _commands(self) -> str:
        name = self.env_id.replace("/", "-")
        run = f"logs/{self.algo}/{name}_1"
        # The number in the paths below; load-from-hub says so if there is such a run already.
        chosen = f"--algo {self.algo} --env {self.env_id} -f logs --exp-id 1"
        repository = f"-orga {self.organization}" + (f" -name {self.repo_name}" if self.repo_name else "")
        load = f"sb3-uav load-from-hub {chosen} {repository}"
        # Others can only be unpickled.
        is_ours = str(self.hyperparams.get("policy")).rpartition(".")[2] in ("AllocatorPolicy", "RouterPolicy")
        enjoy = f"sb3-uav enjoy {chosen}" + ("" if is_ours else " --trust")
        solver = f"dl-drl:allocator={run}/{name}.zip,router={run}/router.zip"
        evaluate = f"sb3-uav evaluate --instances my_instances.npz --solvers {solver} ortools --out results"
        return "\n".join(["```bash", load, *([evaluate] if self.has_router else []), enjoy, "```"])


def _dump(value: Any) -> str:
    try:
        return yaml.safe_dump(value, sort_keys=False, width=110)
    except yaml.YAMLError:
        # Classes, from a configuration in Python.
        return yaml.safe_dump({str(key): repr(item) for key, item in value.items()}, sort_keys=False)
