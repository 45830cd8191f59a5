"""
Trains RL4CO's attention model in turns with ``training_throughput.py``, which starts this file with the Python of RL4CO.

That environment does not need sb3_uav.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import time
import warnings
from typing import Any, NamedTuple

import torch as th


class Measurement(NamedTuple):
    """
    :param n_instances: Training instances
    :param seconds: Duration in seconds
    :param cpu_seconds: CPU time of all threads
    :param mean_return: Mean return of the last episodes
    """

    n_instances: int
    seconds: float
    cpu_seconds: float
    mean_return: float


class Clock:
    """Time since it was started."""

    def __init__(self) -> None:
        self.start, self.cpu_start = time.perf_counter(), time.process_time()

    def read(self) -> tuple[float, float]:
        """:return: Seconds, CPU seconds"""
        return time.perf_counter() - self.start, time.process_time() - self.cpu_start


def serve(n_tasks: int, max_distance: float, batch_size: int, epoch_batches: int, num_threads: int, **shape: Any) -> None:
    """
    Train in RL4CO's environment: for every number of seconds on the standard input, a measurement on the standard output.

    :param n_tasks: Number of tasks
    :param max_distance: Maximum flight distance
    :param batch_size: Instances per update
    :param epoch_batches: Updates per epoch
    :param num_threads: Threads of torch
    :param shape: Layers, width, heads and normalization
    """
    # Output of the libraries must not mix with the messages.
    messages = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)

    from lightning.pytorch import Callback  # type: ignore[import-not-found]
    from rl4co.envs import OPEnv  # type: ignore[import-not-found]
    from rl4co.envs.routing.op.generator import OPGenerator  # type: ignore[import-not-found]
    from rl4co.models import REINFORCE, AttentionModelPolicy  # type: ignore[import-not-found]
    from rl4co.utils import RL4COTrainer  # type: ignore[import-not-found]

    # After these imports, which change the number.
    th.set_num_threads(num_threads)
    th.manual_seed(0)

    class Turns(Callback):
        """
        Trains in turns with the other competitors.

        The time between the starts of two epochs includes the updates, and generating the next instances with their rollouts.
        """

        clock: Clock | None = None

        def on_train_epoch_start(self, trainer: Any, model: Any) -> None:
            if trainer.current_epoch == 0:
                return
            if self.clock is None:
                assert th.get_num_threads() == num_threads
                # Disable further tests of the baseline's policy.
                model.baseline.epoch_callback = lambda *args, **kwargs: None
                self._wait("ready")
                return
            self.n_epochs += 1
            elapsed = self.clock.read()
            if elapsed[0] >= self.seconds:
                n_instances = self.n_epochs * epoch_batches * batch_size
                self._wait(Measurement(n_instances, *elapsed, sum(self.returns) / len(self.returns)))

        def on_train_batch_end(self, trainer: Any, model: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
            if self.clock is not None:
                self.returns.append(float(outputs["train/reward"]))

        def _wait(self, message: Any) -> None:
            print(json.dumps(message), file=messages, flush=True)
            self.seconds = float(sys.stdin.readline())
            self.n_epochs, self.returns, self.clock = 0, list[float](), Clock()

    generator = OPGenerator(num_loc=n_tasks, max_length=max_distance, prize_type="const")
    # RL4CO 0.7.0 reads the device of constant prizes there but never sets it.
    generator.device = "cpu"
    env = OPEnv(generator)
    policy = AttentionModelPolicy(
        env_name=env.name,
        embed_dim=shape["embed_dim"],
        num_encoder_layers=shape["n_layers"],
        num_heads=shape["n_heads"],
        feedforward_hidden=shape["ff_dim"],
        normalization=shape["normalization"],
    )
    # Neither validation nor the baseline's test is measured: the smallest sets that setting them up allows.
    model = REINFORCE(
        env,
        policy,
        baseline="rollout",
        batch_size=batch_size,
        train_data_size=epoch_batches * batch_size,
        val_data_size=2,
        test_data_size=2,
        optimizer_kwargs={"lr": 1e-4},
    )
    trainer = RL4COTrainer(
        accelerator="cpu",
        devices=1,
        precision="32-true",
        max_epochs=10**9,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        limit_val_batches=0,
        num_sanity_val_steps=0,
        callbacks=[Turns()],
    )
    trainer.fit(model)


if __name__ == "__main__":
    serve(**json.loads(sys.argv[1]))
