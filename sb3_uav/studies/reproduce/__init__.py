"""The tables and figures of the DL-DRL paper, by one command each (``sb3-uav reproduce``)."""
