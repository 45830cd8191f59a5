from sb3_uav.local_search.search import LocalSearch, improve, repair, repair_best

__all__ = ["LocalSearch", "improve", "repair", "repair_best"]
