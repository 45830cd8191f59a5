"""
Instances of research as missions: Chao's files, OPLib, and ``.npz`` of this package.

Their points are in a plane, in meters where nothing else is said. Service in an ``.npz`` is flight distance; here it is the
time that takes at 1 m/s, which is then the speed of the UAVs.
"""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from sb3_uav.common.npz import read_npz_stream
from sb3_uav.envs.instance_files import check_array_names
from sb3_uav.envs.instances import Instances
from sb3_uav.evaluation.benchmarks.chao import read_chao
from sb3_uav.evaluation.benchmarks.oplib import read_oplib
from sb3_uav.missions.checks import MAX_TASKS, check_fleet_size
from sb3_uav.missions.fleet import Fleet, Uav
from sb3_uav.missions.tasks import TaskList

# 100,000 tasks take less than half; vrplib is slow.
_MOST_TEXT_BYTES = 8 * 2**20
_MOST_SECTIONS = 20
# Of all arrays of a file together; deflate packs a thousandfold.
_MOST_NPZ_BYTES = 256 * 2**20
_MOST_NPZ_ARRAYS = 100
# Lines of Chao's files before the first point.
_CHAO_HEADER = 3


def read_chao_tasks(data: bytes, source: str, meters_per_unit: float = 1.0) -> TaskList:
    """
    :param data: Content of a team orienteering file
    :param source: Its name, for errors
    :param meters_per_unit: Length of its unit
    :return: The tasks, named by the number of their point, and the fleet
    :raises ValueError: If it is damaged; the message names the line
    """
    instance = read_chao(Path(source), _text(data, source), "")
    return _task_list(
        instance.instances, instance.nodes, [f"row {node + _CHAO_HEADER}" for node in instance.nodes], source, meters_per_unit
    )


def read_oplib_tasks(data: bytes, source: str, meters_per_unit: float = 1.0) -> TaskList:
    """
    Lengths are Euclidean, not rounded as the rule of the files has it.

    :param data: Content of an OPLib file
    :param source: Its name, for errors
    :param meters_per_unit: Length of its unit
    :return: The tasks, named by the number of their node, and one UAV
    :raises ValueError: If it is damaged, or its metric is not EUC_2D
    :raises ImportError: If vrplib is not installed
    """
    # Whatever the metric, vrplib would build the matrix; and it copies the whole file for every section.
    if re.search(rb"edge_weight_section", data, re.IGNORECASE) or data.count(b"_SECTION") > _MOST_SECTIONS:
        raise ValueError(f"{source}: the file lists distances, or has too many sections; only EUC_2D can be solved.")
    instance = read_oplib(Path(source), _text(data, source), "")
    return _task_list(instance.instances, instance.nodes, [f"node {node}" for node in instance.nodes], source, meters_per_unit)


def read_npz_tasks(data: bytes, source: str, meters_per_unit: float = 1.0, row: int | None = None) -> TaskList:
    """
    :param data: Content of an ``.npz``
    :param source: Its name, for errors
    :param meters_per_unit: Length of its unit
    :param row: Which of its instances, from 0; needed if there are several
    :return: The tasks, named by their index from 0, and the fleet
    :raises ValueError: If it is damaged, too large, or nothing says which instance is meant
    """
    _check_npz_size(data, source)
    arrays = read_npz_stream(io.BytesIO(data), source, "write it again")
    check_array_names(arrays, [field.name for field in fields(Instances)], source)
    batch = Instances.from_arrays(**arrays, source=source)
    if row is None and len(batch) > 1:
        raise ValueError(f"{source}: there are {len(batch)} instances; say which one with row, from 0 to {len(batch) - 1}.")
    chosen = 0 if row is None else row
    if not 0 <= chosen < len(batch):
        raise ValueError(f"{source}: row is {chosen}, but the file has rows 0 to {len(batch) - 1}.")
    size = int(batch.task_mask[chosen].sum())
    if size == 0:
        raise ValueError(f"{source}: instance {chosen} has no tasks.")
    instance = batch[chosen].trim(size)
    return _task_list(instance, range(size), [f"task {task}" for task in range(size)], source, meters_per_unit)


def _check_npz_size(data: bytes, source: str) -> None:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as file:
            members = file.infolist()
    except Exception as error:
        # Given damaged bytes, zipfile raises almost anything.
        found = str(error) or type(error).__name__
        raise ValueError(f"{source}: not an intact .npz of plain arrays ({found}); write it again.") from error
    total = sum(member.file_size for member in members)
    if len(members) > _MOST_NPZ_ARRAYS or total > _MOST_NPZ_BYTES:
        raise ValueError(
            f"{source}: the file holds {len(members)} arrays of {total / 2**20:.0f} MiB; at most {_MOST_NPZ_ARRAYS} arrays of "
            f"{_MOST_NPZ_BYTES / 2**20:.0f} MiB are read; save fewer instances."
        )


def _text(data: bytes, source: str) -> str:
    if len(data) > _MOST_TEXT_BYTES:
        raise ValueError(f"{source}: the file has {len(data)} bytes; at most {_MOST_TEXT_BYTES} of an instance are read.")
    # Comments may be in any encoding; where numbers are damaged, the readers say so.
    text = data.decode("utf-8-sig", errors="replace")
    # Over a million spaces in a line, the expressions of vrplib would go a million times.
    return "\n".join(" ".join(line.split()) for line in text.splitlines())


def _task_list(
    instance: Instances, names: Sequence[int], places: Sequence[str], source: str, meters_per_unit: float
) -> TaskList:
    """:return: A batch of one, without padding, as tasks with their fleet"""
    check_fleet_size(instance.n_uavs, source)
    if instance.n_tasks > MAX_TASKS:
        raise ValueError(f"{source}: there are {instance.n_tasks} tasks, but at most {MAX_TASKS} are read.")
    speed = None if instance.service is None else 1.0
    ranges = (instance.uav_distance[0] * meters_per_unit).tolist()
    starts, ends = (
        [None] * instance.n_uavs if points is None else [(x, y) for x, y in points[0].tolist()]
        for points in (instance.start, instance.end)
    )
    uavs = (
        Uav(f"uav-{number}", range_m, speed, start, end)
        for number, (range_m, start, end) in enumerate(zip(ranges, starts, ends, strict=True), start=1)
    )
    return TaskList.of(
        names,
        instance.tasks[0].numpy(),
        "plane",
        instance.values[0].numpy(),
        instance.service_cost[0].numpy() * meters_per_unit,
        None if instance.must_serve is None else instance.must_serve[0].numpy(),
        depot=instance.depot[0].numpy(),
        meters_per_unit=meters_per_unit,
        fleet=Fleet(tuple(uavs), source, "plane"),
        places=tuple(places),
        source=source,
    )
