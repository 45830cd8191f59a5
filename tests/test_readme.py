"""What the pages show is as short as they say, and their commands have the flags; `test_doc_blocks.py` runs them."""

import io
import re
import shlex
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path

import pytest

from sb3_uav.cli import main as cli

ROOT = Path(__file__).parents[1]


def test_training_takes_few_lines():
    examples = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.DOTALL)
    (training,) = (example for example in examples if "ITSCallback" in example)
    assert len([line for line in training.splitlines() if line and "import" not in line]) <= 8


# ------------------------------------------------------------------------------------------------------ shell commands

PAGES = ["README.md", *(str(path.relative_to(ROOT)) for path in sorted((ROOT / "docs").rglob("*.md")))]


def shell_commands() -> list[list[str]]:
    """Every `sb3-uav ...` of the pages, as a list of words."""
    found = []
    for page in PAGES:
        text = (ROOT / page).read_text(encoding="utf-8").replace("\\\n", " ")
        for block in re.findall(r"```(?:bash|sh)\n(.*?)```", text, flags=re.DOTALL):
            lines = [line for line in block.splitlines() if line.startswith("sb3-uav ")]
            found += [shlex.split(line, comments=True) for line in lines]
    return found


@cache
def help_text(command: str) -> str:
    """What the command prints for --help."""
    printed = io.StringIO()
    with redirect_stdout(printed), pytest.raises(SystemExit):
        cli.main([command, "--help"])
    return printed.getvalue()


@pytest.mark.parametrize("words", shell_commands(), ids=lambda words: " ".join(words)[:60])
def test_shell_commands_have_the_flags_that_pages_show(words):
    pytest.importorskip("rl_zoo3")
    if "plot" in words[1]:
        # rl_zoo3 imports it before it parses anything.
        pytest.importorskip("seaborn")
    known = set(re.findall(r"(?<![\w-])--?[a-zA-Z][\w-]*", help_text(words[1])))
    assert {word for word in words[2:] if re.match(r"--?[a-zA-Z]", word)} <= known
