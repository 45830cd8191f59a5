"""The Hugging Face Hub: names of repositories, uploads and downloads."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import huggingface_hub
from huggingface_sb3 import EnvironmentName, ModelName, ModelRepoId

ResultT = TypeVar("ResultT")


def repository_id(organization: str, repo_name: str | None, algo: str, env_id: str) -> str:
    """
    :param organization: Owner of the repository
    :param repo_name: Its name; that of rl_zoo3, ``ALGO-ENV``, when None
    :param algo: rl_zoo3's name of the algorithm
    :param env_id: Id of the environment
    :return: ``organization/name``
    """
    return str(ModelRepoId(organization, repo_name or ModelName(algo, EnvironmentName(env_id))))


def upload(repo_id: str, folder: Path, message: str) -> str:
    """
    :param repo_id: The repository, created if missing
    :param folder: Its new content
    :param message: Message of the commit
    :return: Address of the repository
    :raises OSError: If the Hub cannot be reached, or refuses
    """
    api = huggingface_hub.HfApi()

    def push() -> str:
        url = api.create_repo(repo_id=repo_id, exist_ok=True)
        api.upload_folder(repo_id=repo_id, folder_path=folder, commit_message=message)
        return str(url)

    return _asking_the_hub(repo_id, push, "log in with `hf auth login`, or write it to a folder with --local-dir")


def list_files(repo_id: str) -> set[str]:
    """
    :param repo_id: A repository
    :return: Names of its files
    :raises OSError: If the Hub cannot be reached, or there is no such repository
    """
    api = huggingface_hub.HfApi()
    return _asking_the_hub(repo_id, lambda: set(api.list_repo_files(repo_id)), "check its name and the connection")


def download(repo_id: str, name: str) -> Path:
    """
    :param repo_id: A repository
    :param name: One of its files
    :return: A copy in the cache of huggingface_hub
    :raises OSError: If the Hub cannot be reached
    """
    return Path(
        _asking_the_hub(repo_id, lambda: huggingface_hub.hf_hub_download(repo_id, name), "check the connection, and try again")
    )


def _asking_the_hub(repo_id: str, ask: Callable[[], ResultT], advice: str) -> ResultT:
    try:
        return ask()
    # The errors of huggingface_hub, and of the packages that it speaks HTTP with, have no common class in all versions.
    except Exception as error:
        reason: Any = str(error).strip().splitlines() or [type(error).__name__]
        raise OSError(f"{repo_id} on the Hugging Face Hub: {reason[0]}; {advice}.") from error
