"""What the tests of public benchmarks share: the small files beside them, and writers of both formats."""

from __future__ import annotations

from pathlib import Path

from sb3_uav.envs import Instances

FILES = Path(__file__).parent / "bench_files"
BEST_KNOWN = FILES / "best_known.csv"


def chao_text(instance: Instances, order: str = "{x!r}\t{y!r}\t{score!r}") -> str:
    """A batch of one as a file of Chao's sets; its UAVs start in the depot and fly equally far."""
    start, end = instance.depot[0].tolist(), instance.uav_end[0, 0].tolist()
    tasks = zip(instance.tasks[0].tolist(), instance.values[0].tolist(), strict=True)
    points = [(*start, 0.0), *((*point, value) for point, value in tasks), (*end, 0.0)]
    lines = [f"n {len(points)}", f"m {instance.n_uavs}", f"tmax {float(instance.max_distance[0])!r}"]
    return "\n".join([*lines, *(order.format(x=x, y=y, score=score) for x, y, score in points)]) + "\n"


def oplib_text(instance: Instances, depot: int = 1) -> str:
    """A batch of one with one UAV as an OPLib file, whose depot is the node of this number."""
    points, scores = instance.tasks[0].tolist(), instance.values[0].tolist()
    points.insert(depot - 1, instance.depot[0].tolist())
    scores.insert(depot - 1, 0.0)
    lines = [
        "NAME : written",
        "COMMENT : by a test",
        "TYPE : OP",
        f"DIMENSION : {len(points)}",
        f"COST_LIMIT : {float(instance.max_distance[0])!r}",
        "EDGE_WEIGHT_TYPE : EUC_2D",
        "NODE_COORD_SECTION",
        *(f"{number} {x!r} {y!r}" for number, (x, y) in enumerate(points, start=1)),
        "NODE_SCORE_SECTION",
        *(f"{number} {score!r}" for number, score in enumerate(scores, start=1)),
        "DEPOT_SECTION",
        f"{depot}",
        "-1",
        "EOF",
    ]
    return "\n".join(lines) + "\n"
