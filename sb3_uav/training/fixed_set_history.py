"""The evaluations on a fixed set, and their file."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_uav.common.files import write_atomically
from sb3_uav.common.npz import read_npz

RESULTS_FILE = "evaluations.npz"


class FixedSetResult(NamedTuple):
    """
    :param greedy: ``(n_instances,)`` float64, returns of the greedy episodes
    :param lengths: ``(n_instances,)`` int64, their steps
    :param sampled: ``(n_instances,)`` float64, best returns of the sampled episodes; ``(0,)`` without sampling
    """

    greedy: np.ndarray
    lengths: np.ndarray
    sampled: np.ndarray

    @classmethod
    def concatenate(cls, parts: Sequence[FixedSetResult]) -> FixedSetResult:
        """
        :param parts: Results on several instances
        :return: The result on all of them, in this order
        """
        return cls(*(np.concatenate(field) for field in zip(*parts, strict=True)))


class EvaluationHistory(NamedTuple):
    """
    What ``evaluations.npz`` holds. The first three arrays are those of SB3's ``EvalCallback``, which rl_zoo3's plots read.

    :param timesteps: ``(n_evaluations,)`` int64, environment steps that the policy had learned from
    :param results: ``(n_evaluations, n_instances)`` float64, returns of the greedy episodes
    :param ep_lengths: ``(n_evaluations, n_instances)`` int64, their steps
    :param sampled: ``(n_evaluations, n_instances)`` float64, best returns of the sampled episodes; no columns without sampling
    :param train_seconds: ``(n_evaluations,)`` float64, wall time of the training so far, evaluations left out
    :param cpu_seconds: ``(n_evaluations,)`` float64, the same of the process on all cores
    """

    timesteps: np.ndarray
    results: np.ndarray
    ep_lengths: np.ndarray
    sampled: np.ndarray
    train_seconds: np.ndarray
    cpu_seconds: np.ndarray

    @classmethod
    def empty(cls, n_instances: int, n_samples: int) -> EvaluationHistory:
        """
        :param n_instances: Size of the set
        :param n_samples: Samples per instance
        :return: No evaluations
        """
        return cls(
            timesteps=np.zeros(0, dtype=np.int64),
            results=np.zeros((0, n_instances)),
            ep_lengths=np.zeros((0, n_instances), dtype=np.int64),
            sampled=np.zeros((0, n_instances if n_samples > 0 else 0)),
            train_seconds=np.zeros(0),
            cpu_seconds=np.zeros(0),
        )

    def append(self, timesteps: int, result: FixedSetResult, seconds: np.ndarray) -> EvaluationHistory:
        """
        :param timesteps: Steps learned from
        :param result: Result of the evaluation
        :param seconds: Wall and CPU seconds of the training
        :return: This history and one more evaluation
        """
        row = (timesteps, result.greedy, result.lengths, result.sampled, *seconds)
        return EvaluationHistory(
            *(np.concatenate([old, np.asarray([new], dtype=old.dtype)]) for old, new in zip(self, row, strict=True))
        )

    def until(self, timesteps: int) -> EvaluationHistory:
        """
        :param timesteps: Steps learned from
        :return: The evaluations up to there
        """
        return EvaluationHistory(*(array[self.timesteps <= timesteps] for array in self))

    def save(self, path: Path, n_samples: int) -> None:
        """
        :param path: The ``.npz`` to write, under a temporary name that is renamed
        :param n_samples: Samples per instance, noted in it for readers
        """
        file = io.BytesIO()
        np.savez(file, **self._asdict(), n_samples=n_samples)
        write_atomically(path, file.getvalue())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> EvaluationHistory:
        """
        :param path: An ``evaluations.npz`` of :class:`FixedSetEvalCallback`
        :return: The history
        :raises FileNotFoundError: If there is no such file
        :raises ValueError: If it is damaged or was written by something else
        """
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file; give the {RESULTS_FILE} that FixedSetEvalCallback wrote.")
        arrays = read_npz(path, "delete it and evaluate again")
        missing = set(cls._fields) - set(arrays)
        if missing:
            raise ValueError(f"{path}: arrays {sorted(missing)} are missing; it was not written by FixedSetEvalCallback.")
        history = cls(**{name: arrays[name] for name in cls._fields})
        history._check(path)
        return history

    def _check(self, path: Path) -> None:
        """:raises ValueError: If the arrays do not fit together; ``path`` names their file"""
        n_evaluations, n_instances = (*self.results.shape, -1, -1)[:2]
        fields: dict[str, list[tuple[int, ...]]] = {
            "results": [(n_evaluations, n_instances)],
            "timesteps": [(n_evaluations,)],
            "ep_lengths": [(n_evaluations, n_instances)],
            "sampled": [(n_evaluations, n_instances), (n_evaluations, 0)],
            "train_seconds": [(n_evaluations,)],
            "cpu_seconds": [(n_evaluations,)],
        }
        for name, shapes in fields.items():
            array = getattr(self, name)
            if array.shape not in shapes or array.dtype.kind not in "iuf":
                raise ValueError(
                    f"{path}: {name} is {array.dtype} of shape {array.shape}, which does not fit results of shape "
                    f"{self.results.shape}; delete it and evaluate again."
                )
