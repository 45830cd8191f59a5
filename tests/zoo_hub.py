"""The Hugging Face Hub as a folder."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import sb3_uav.zoo.hub


class Hub:
    """In place of the Hub: repositories are folders."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.messages: list[str] = []

    @classmethod
    def install(cls, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Hub:
        hub = cls(folder)
        module = sb3_uav.zoo.hub.huggingface_hub
        monkeypatch.setattr(module, "HfApi", lambda: hub)
        monkeypatch.setattr(module, "hf_hub_download", lambda repo_id, name: str(hub.folder / repo_id / name))
        return hub

    def create_repo(self, repo_id: str, exist_ok: bool) -> str:
        assert exist_ok
        (self.folder / repo_id).mkdir(parents=True, exist_ok=True)
        return f"https://huggingface.co/{repo_id}"

    def upload_folder(self, repo_id: str, folder_path: Path, commit_message: str) -> None:
        self.messages.append(commit_message)
        shutil.copytree(folder_path, self.folder / repo_id, dirs_exist_ok=True)

    def list_repo_files(self, repo_id: str) -> list[str]:
        if not (self.folder / repo_id).is_dir():
            raise RuntimeError("404 Client Error\nRepository Not Found")
        return [path.name for path in (self.folder / repo_id).iterdir()]
