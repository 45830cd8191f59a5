"""What strangers may write into zips: refused with a reason, before memory or time is spent, and never executed."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
from forked import run_forked
from malicious_zips import malicious_zips

from sb3_uav.policies import RouterPolicy
from sb3_uav.policies.loading import load_policy
from sb3_uav.reinforce import REINFORCE

# Not on Windows.
resource = pytest.importorskip("resource")
TINY = dict(embed_dim=8, n_layers=1, n_heads=2, ff_dim=16, bias_dim=8)
# Above what the process has before, and for all files together.
MEMORY, SECONDS = 300 * 2**20, 100


@pytest.fixture(scope="module")
def router_zip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("zips") / "router.zip"
    REINFORCE(RouterPolicy, "RoutePlanning-N20-v0", policy_kwargs=TINY, device="cpu").save(path)
    return path


def refuse_all(good: Path) -> None:
    """Read every malicious zip, in a process that cannot take more memory or time."""
    warnings.simplefilter("ignore")
    load_policy(good, "cpu")
    proof = Path("executed")
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 0
    wrong = []
    for name, path in malicious_zips(good, Path(), proof):
        limits = resource.getrlimit(resource.RLIMIT_AS)
        if pages:
            # The corpus itself is larger than what is allowed here.
            used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, limits[1]))
        try:
            load_policy(path, "cpu")
            wrong.append(f"{name}: accepted")
        except ValueError as error:
            if str(path) not in str(error) or "\n" in str(error) or len(str(error)) > 1500:
                wrong.append(f"{name}: {error!s:.300}")
        except BaseException as error:
            wrong.append(f"{name}: {type(error).__name__} {error!s:.300}")
        finally:
            resource.setrlimit(resource.RLIMIT_AS, limits)
        if proof.exists():
            wrong.append(f"{name}: executed")
            proof.unlink()
        print(name)
    assert not wrong, "\n".join(wrong)


@pytest.mark.slow
def test_malicious_zips_are_refused(router_zip: Path, tmp_path: Path) -> None:
    refused = run_forked(refuse_all, tmp_path, router_zip, limit=SECONDS).split()
    assert len(refused) == len(set(refused)) > 100
