"""The tables and figures of the DL-DRL paper (``sb3-uav reproduce``)."""
