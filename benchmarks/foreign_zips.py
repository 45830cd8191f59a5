"""
CPU seconds and memory that the zips of ``tests/malicious_zips.py`` take until they are refused.

    python benchmarks/foreign_zips.py [--all]

It needs Linux, where the peak of a process can be reset.
"""

from __future__ import annotations

import argparse
import gc
import re
import sys
import tempfile
import time
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from malicious_zips import malicious_zips

from sb3_uav.policies import RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.reinforce import REINFORCE

SMALL = dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=16, bias_dim=8)


def memory(field: str) -> int:
    """:return: A field of ``/proc/self/status`` in kB"""
    found = re.search(rf"{field}:\s*(\d+)", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--all", action="store_true", help="print every zip, not the ten slowest and largest")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        good, proof = folder / "good.zip", folder / "executed"
        REINFORCE(RouterPolicy, "RoutePlanning-N20-v0", policy_kwargs=SMALL, device="cpu").save(good)
        # What torch imports when it first builds a network is not measured.
        load_policy(good, "cpu")
        rows: list[tuple[float, float, str, str]] = []
        for name, path in malicious_zips(good, folder, proof):
            gc.collect()
            Path("/proc/self/clear_refs").write_text("5")
            before, start = memory("VmRSS"), time.process_time()
            try:
                load_policy(path, "cpu")
                outcome = "ACCEPTED"
            except ValueError as error:
                outcome = str(error).replace(str(path), "file")
            outcome = "EXECUTED" if proof.exists() else outcome
            rows.append((time.process_time() - start, (memory("VmHWM") - before) / 1024, name, outcome))
    wrong = [row for row in rows if row[3] in ("ACCEPTED", "EXECUTED")]
    slowest, largest = sorted(rows, reverse=True), sorted(rows, key=lambda row: -row[1])
    for seconds, growth, name, outcome in sorted(rows) if args.all else [*slowest[:5], *largest[:5], *wrong]:
        print(f"{seconds:6.3f} s {growth:6.1f} MB  {name}: {outcome:.100}")
    print(f"{len(rows)} zips, {len(wrong)} accepted or executed; at most {slowest[0][0]:.2f} s and {largest[0][1]:.0f} MB")


if __name__ == "__main__":
    main()
