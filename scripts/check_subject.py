"""
Fail if the subject of a commit message is empty or longer than 72 characters.

    python scripts/check_subject.py MESSAGE_FILE        (the commit-msg hook)
    git log --format=%s BASE.. | python scripts/check_subject.py
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

MAX_LENGTH = 72


def problems(subjects: Sequence[str]) -> list[str]:
    """
    :param subjects: First lines of commit messages
    :return: One line for each that is empty or too long
    """
    return [
        f"{len(subject)} characters instead of 1 to {MAX_LENGTH}: {subject}"
        for subject in subjects
        if not 0 < len(subject) <= MAX_LENGTH
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: The file of one message; subjects come from the standard input without it
    :return: Exit code: 1 if a subject is empty or too long
    """
    files = list(sys.argv[1:] if argv is None else argv)
    if files:
        lines = Path(files[0]).read_text(encoding="utf-8").splitlines()
        subjects = [next((line for line in lines if not line.startswith("#")), "")]
    else:
        subjects = sys.stdin.read().splitlines()
    found = problems(subjects)
    for problem in found:
        print(problem, file=sys.stderr)
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
