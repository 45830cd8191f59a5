"""
Several processes that work on one task, by ``torch.distributed``; everything here does nothing in a single process.

``torchrun`` starts the processes and tells them of each other by environment variables; :func:`process_group` connects them.
Every function below that names other ranks is a collective one: all ranks must call it, in the same order.

https://docs.pytorch.org/docs/stable/elastic/run.html
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from datetime import timedelta
from typing import Any, TypeVar, cast

import torch as th
import torch.distributed as dist

from sb3_uav.common.interruption import Interruption, exit_code, was_received

ResultT = TypeVar("ResultT")

# Longer than any evaluation on rank 0, for which the others wait. torchrun ends them at once if a process fails.
_TIMEOUT = timedelta(hours=2)
_USER_ERROR = 2
_TORCHRUN = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")


def world_size() -> int:
    """:return: Number of connected processes; 1 without others"""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def rank() -> int:
    """:return: Number of this process among them, from 0"""
    return dist.get_rank() if world_size() > 1 else 0


def is_main() -> bool:
    """:return: Whether this is the process that writes files and reports"""
    return rank() == 0


def is_launched() -> bool:
    """:return: Whether ``torchrun``, or a launcher like it, has started this process with others"""
    return all(name in os.environ for name in _TORCHRUN) and int(os.environ["WORLD_SIZE"]) > 1


@contextmanager
def process_group(timeout: timedelta = _TIMEOUT) -> Iterator[None]:
    """
    Connect the processes that ``torchrun`` has started, by gloo for tensors on the CPU and NCCL for those on GPUs.

    Of an error that several of them raise only the first is passed on, and of an interruption only that of rank 0; the others
    end with ``SystemExit``.

    :param timeout: How long one of them may wait for another
    :raises ValueError: If this process lost the connection to another one
    :raises Interruption: In place of one on rank 0, with the command that starts all processes again
    """
    if not is_launched() or world_size() > 1:
        yield
        return
    local_rank = int(os.environ.get("LOCAL_RANK", 0))
    n_local = int(os.environ.get("LOCAL_WORLD_SIZE", 1))
    # NCCL takes one process for each GPU.
    has_gpus = th.cuda.is_available() and th.cuda.device_count() >= n_local and dist.is_nccl_available()
    if has_gpus:
        th.cuda.set_device(local_rank)
    root, number, size = next(dist.rendezvous("env://", timeout=_TIMEOUT))
    backend = "cpu:gloo,cuda:nccl" if has_gpus else "gloo"
    dist.init_process_group(backend, store=dist.PrefixStore("group", root), rank=number, world_size=size, timeout=timeout)
    store = dist.PrefixStore("errors", root)
    try:
        yield
        # Nobody ends, and takes the connection with it, while another one still works.
        barrier()
        dist.destroy_process_group()
    except KeyboardInterrupt as error:
        raise _interruption(number, error) from error
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        if was_received():
            # All of them were interrupted, and another one has ended before this one.
            raise _interruption(number, KeyboardInterrupt()) from error
        if not _is_first(store):
            # Not even its traceback: the error is that of another process, or the end of its connection.
            raise SystemExit(_USER_ERROR) from None
        if isinstance(error, RuntimeError) and _is_lost_connection(error):
            raise ValueError(
                f"another process of this run has ended, so this one (rank {dist.get_rank()}) stops too; start all of them "
                f"again, from the last checkpoint ({' '.join(str(error).split())[:120]})."
            ) from error
        raise


def _interruption(number: int, error: KeyboardInterrupt) -> BaseException:
    """
    :param number: The rank
    :param error: What interrupted it
    :return: What it ends with
    """
    if number > 0:
        return SystemExit(exit_code())
    if not isinstance(error, Interruption) or not error.words:
        return error
    n_nodes = os.environ.get("GROUP_WORLD_SIZE", "1")
    launcher = ["torchrun", *(["--nnodes", n_nodes] if n_nodes != "1" else [])]
    launcher += ["--nproc-per-node", os.environ.get("LOCAL_WORLD_SIZE", os.environ["WORLD_SIZE"])]
    # The command's name is that of the package's script; torchrun starts modules.
    return Interruption([*launcher, "-m", error.words[0].replace("-", "_"), *error.words[1:]], error.changes)


def _is_first(store: Any) -> bool:
    """Whether no other process has failed before."""
    try:
        return store.add("failed", 1) == 1
    except RuntimeError:
        # The store lives in a process that has ended.
        return False


def _is_lost_connection(error: RuntimeError) -> bool:
    text = str(error).lower()
    return isinstance(error, dist.DistError) or any(
        word in text for word in ("connection", "peer", "gloo", "nccl", "socket", "timed out")
    )


@contextmanager
def quiet_unless_main() -> Iterator[None]:
    """Neither standard output nor warnings in any process but rank 0."""
    if is_main():
        yield
        return
    with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stdout(nowhere), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
        sys.stdout.flush()


def barrier() -> None:
    """Wait for all ranks."""
    if world_size() > 1:
        # By a tensor on the CPU: torch's own barrier would choose a GPU.
        dist.all_reduce(th.zeros(1, dtype=th.int64, device="cpu"))


def broadcast(value: ResultT) -> ResultT:
    """
    :param value: Anything that can be pickled
    :return: That of rank 0
    """
    if world_size() == 1:
        return value
    values = [value if is_main() else None]
    dist.broadcast_object_list(values, src=0, device=th.device("cpu"))
    return cast(ResultT, values[0])


def on_main(function: Callable[[], ResultT]) -> ResultT:
    """
    :param function: Called by rank 0 alone
    :return: What it returned there
    :raises ValueError: On all ranks, if it failed there; rank 0 raises the error itself
    """
    if world_size() == 1:
        return function()
    result: Any = None
    failure: Exception | None = None
    if is_main():
        try:
            result = function()
        except Exception as error:
            failure = error
    result, text = broadcast((result, None if failure is None else str(failure)))
    if failure is not None:
        raise failure
    if text is not None:
        raise ValueError(text)
    return cast(ResultT, result)


def shard(n: int) -> slice:
    """
    :param n: Number of rows of the whole task
    :return: The rows of this rank: parts of equal size, but for one row; all of them on every rank if there are fewer rows
        than ranks
    """
    size = world_size()
    if n < size:
        return slice(0, n)
    return slice(rank() * n // size, (rank() + 1) * n // size)


def gather(part: th.Tensor, n: int, ragged: bool = False) -> th.Tensor:
    """
    :param part: ``(n_rows, ...)``, the rows of this rank
    :param n: Number of rows of the whole task, of which each rank has its :func:`shard`
    :param ragged: Whether the last dimension may differ between ranks; it is padded with 0 to the longest
    :return: ``(n, ...)``, on the device of ``part``
    """
    size = world_size()
    if size == 1 or n < size:
        return part
    sent = part.detach().cpu()
    if ragged:
        longest = th.tensor(sent.shape[-1], dtype=th.int64, device="cpu")
        dist.all_reduce(longest, dist.ReduceOp.MAX)
        sent = th.nn.functional.pad(sent, (0, int(longest) - sent.shape[-1]))
    # All ranks must send alike, and some have one row fewer.
    missing = -(-n // size) - len(sent)
    sent = th.cat([sent, sent[:1].expand(missing, *sent.shape[1:])])
    # Booleans are no numbers for gloo.
    sent = (sent.to(th.uint8) if sent.dtype == th.bool else sent).contiguous()
    parts = [th.empty_like(sent) for _ in range(size)]
    dist.all_gather(parts, sent)
    lengths = [(other + 1) * n // size - other * n // size for other in range(size)]
    return th.cat([rows[:length] for rows, length in zip(parts, lengths, strict=True)]).to(part.device, part.dtype)


def total(number: float) -> float:
    """
    :param number: A number of this rank
    :return: The sum over all ranks
    """
    return totals(number)[0]


def totals(*numbers: float) -> list[float]:
    """
    :param numbers: Numbers of this rank
    :return: The sum of each over all ranks
    """
    if world_size() == 1:
        return list(numbers)
    summed = th.tensor(numbers, dtype=th.float64, device="cpu")
    dist.all_reduce(summed)
    return summed.tolist()


def all_agree(condition: bool) -> bool:
    """:return: Whether it holds on all ranks"""
    return total(float(not condition)) == 0.0 if world_size() > 1 else condition


def require_equal(what: str, value: Any) -> None:
    """
    :param what: What it is, as the error names it
    :param value: Something plain that all ranks must have alike
    :raises ValueError: On all ranks, if one of them has another value than rank 0
    """
    expected = broadcast(value)
    if not all_agree(expected == value):
        raise ValueError(
            f"The processes of this run differ in {what} (rank {rank()}: {value!r:.120}, rank 0: {expected!r:.120}); give all "
            "of them the same arguments and files."
        )


def share_tensors(tensors: Iterable[th.Tensor]) -> None:
    """
    :param tensors: Replaced by those of rank 0
    """
    if world_size() > 1:
        for tensor in tensors:
            dist.broadcast(tensor.data, src=0)


def sum_gradients(parameters: Sequence[th.nn.Parameter], *numbers: float) -> list[float]:
    """
    Replace gradients by their sums over all ranks, each of which has the gradient of its part of the loss.

    :param parameters: The same on all ranks, at least one of them learning
    :param numbers: Numbers of this rank, sent along
    :return: Their sums, in float32
    """
    if world_size() == 1:
        return list(numbers)
    learning = [parameter for parameter in parameters if parameter.requires_grad]
    # One message for all; some parameters may have a gradient on other ranks only.
    gradients = [th.zeros_like(p) if p.grad is None else p.grad for p in learning]
    others = gradients[0].new_tensor([*(float(p.grad is not None) for p in learning), *numbers])
    message = th.cat([*(gradient.flatten() for gradient in gradients), others])
    dist.all_reduce(message)
    *summed, others = message.split([*(p.numel() for p in learning), len(others)])
    counts, sums = others.tolist()[: len(learning)], others.tolist()[len(learning) :]
    for parameter, gradient, count in zip(learning, summed, counts, strict=True):
        if count > 0:
            parameter.grad = gradient.view_as(parameter)
    return sums


def sum_with_gradient(tensor: th.Tensor) -> th.Tensor:
    """
    :param tensor: Of the same shape on all ranks
    :return: The sum over all ranks, through which gradients flow back to each of them
    """
    return tensor if world_size() == 1 else _Sum.apply(tensor)


class _Sum(th.autograd.Function):
    """The sum over all ranks. Torch's own functions for this are deprecated or private."""

    @staticmethod
    def forward(ctx: Any, tensor: th.Tensor) -> th.Tensor:
        summed = tensor.detach().clone(memory_format=th.contiguous_format)
        dist.all_reduce(summed)
        return summed

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> th.Tensor:
        # Each rank's part is in the sum of every rank.
        summed = gradient.clone(memory_format=th.contiguous_format)
        dist.all_reduce(summed)
        return summed
