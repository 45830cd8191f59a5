"""The planner in a browser, and as a JSON API (``sb3-uav serve``)."""
