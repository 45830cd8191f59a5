"""What of old routes still fits, and how their order is kept."""

import pytest

from sb3_uav.envs.instances import Instances
from sb3_uav.envs.schedule import Schedule, check_schedule
from sb3_uav.missions.old_routes import OldRoutes


def old_routes(points, routes, reach, **fields) -> tuple[Instances, OldRoutes]:
    """UAVs fly from (0, 0) to (0, 0)."""
    instance = Instances.from_arrays((0.0, 0.0), points, max_distance=reach, n_uavs=len(routes), **fields)
    return instance, OldRoutes(instance, routes)


def test_what_fits_stays():
    instance, old = old_routes([(3.0, 0.0), (3.0, 4.0), (0.0, 1.0)], [[0, 1], [2]], 12.0)
    assert old.fitting() == Schedule([[0, 1], [2]])
    check_schedule(instance, 0, old.fitting())


@pytest.mark.parametrize(
    ("fields", "reach", "left"),
    [
        # Both are worth the same; the one far away takes more of the range.
        ({"values": [1.0, 1.0, 1.0]}, 10.0, [0, 1]),
        # Five times the value for about four times the range.
        ({"values": [1.0, 1.0, 20.0]}, 10.0, [2]),
        ({"values": [1.0, 1.0, 1.0], "must_serve": [False, False, True]}, 10.0, [2]),
        # Service takes range too.
        ({"values": [1.0, 1.0, 1.0], "service": [0.0, 9.0, 0.0]}, 13.0, [0, 2]),
    ],
)
def test_what_is_worth_least_for_its_range_goes_first(fields, reach, left):
    instance, old = old_routes([(-1.0, 0.0), (-1.0, 1.0), (5.0, 0.0)], [[0, 1, 2]], reach, **fields)
    assert old.fitting() == Schedule([left])
    check_schedule(instance, 0, old.fitting())


def test_who_cannot_come_home_has_no_stops():
    _, old = old_routes([(1.0, 0.0)], [[0]], 5.0, start=[(9.0, 0.0)])
    assert old.fitting() == Schedule([[]])


def test_old_order_is_kept_where_the_range_admits_it():
    points = [(1.0, 0.0), (2.0, 0.0), (3.0, 0.0), (2.5, 0.0)]
    shorter, crooked = Schedule([[0, 3, 2]]), [1, 0, 2]
    for reach, expected in ((6.0, [0, 3, 2]), (7.0, [0, 3, 2]), (20.0, [0, 3, 2])):
        instance, old = old_routes(points, [crooked], reach)
        # Task 1 is gone and task 3 is between the two that are left: nothing more can be kept.
        assert old.in_old_order(shorter) == Schedule([expected])
        check_schedule(instance, 0, old.in_old_order(shorter))
    straight = Schedule([[0, 1, 3, 2]])
    # 2 + 1 + 2 + 3 = 8 in the old order, 6 in the straight one; the new task lies on the way.
    for reach, kept in ((6.0, [0, 1, 3, 2]), (8.0, [1, 0, 3, 2])):
        instance, old = old_routes(points, [crooked], reach)
        assert old.in_old_order(straight) == Schedule([kept])
        check_schedule(instance, 0, old.in_old_order(straight))
