"""What a person should know before flying a plan."""

from __future__ import annotations

from sb3_uav.missions.plan import Plan

REVIEW = "A person must review this plan before it is flown. Wind, terrain, obstacles and no-fly zones are not modeled."


def remarks_on(plan: Plan) -> tuple[str, ...]:
    """
    :param plan: The plan
    :return: A sentence for everything that is out of the ordinary, and at the end what no plan takes into account
    """
    remarks = []
    without = [uav.id for uav in plan.fleet if uav.reserve_percent == 0]
    if without:
        remarks.append(f"No reserve is kept ({', '.join(without)}); --reserve PERCENT keeps a part of the range.")
    return (*remarks, REVIEW)
