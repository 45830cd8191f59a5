"""
Importing this module warms a process up, for :func:`multiprocessing.context.BaseContext.set_forkserver_preload`: workers are
forked from a process that has done so.
"""

from __future__ import annotations

from contextlib import suppress

from sb3_uav.web.work import warm

# A worker does the same on its own, where errors are reported.
with suppress(Exception):
    warm()
