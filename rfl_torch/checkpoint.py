"""Save and load a model as one safetensors file; nothing in it can run code.

A file is either whole and as it was written, which its digest shows, or refused. What is in it is
still a stranger's word: `check_layout` makes sure that the tensors fit together before anything is
built from their sizes.
"""

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

FORMAT = "rfl_torch/2"

MOST_BYTES = 8 << 30
"""Largest file that is read: a map of 10,000 nodes and 256 readings takes 6 GB."""

Layout = Mapping[str, tuple[torch.dtype, str]]
"""Names of tensors, each with its type and its sizes as letters: one letter is one number."""


def save_checkpoint(path: Path, config: dict[str, Any], state: dict[str, torch.Tensor]) -> None:
    """Write `state` with the plain-JSON `config` that rebuilds the module around it.

    The file is written beside its place, brought to the disk and renamed: a crash, a full disk or
    a lost supply leaves the old one whole. It may be read by whom the umask says.

    Raises:
        OSError: if it can't be written.
    """
    tensors = {name: tensor.detach().contiguous() for name, tensor in state.items()}
    text = json.dumps(config)
    metadata = {"format": FORMAT, "config": text, "sha256": _digest(text, tensors)}
    new = path.with_name(path.name + ".new")
    try:
        with open(new, "wb") as file:
            file.write(save(tensors, metadata))
            file.flush()
            os.fsync(file.fileno())
        os.replace(new, path)
    finally:
        new.unlink(missing_ok=True)
    _sync_folder(path.parent)


def load_checkpoint(path: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Read back what `save_checkpoint` wrote.

    Raises:
        ValueError: naming the file, if it is cut short, altered, or of another format.
        FileNotFoundError: if there is no such file.
    """
    try:
        if path.exists() and not path.is_file():
            raise ValueError("is a folder or a device, needs a file")
        if path.exists() and path.stat().st_size > MOST_BYTES:
            raise ValueError(f"has {path.stat().st_size} bytes, at most {MOST_BYTES} are read")
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise ValueError(
                    f"holds format {metadata.get('format')!r}, this version reads {FORMAT!r}; "
                    "retrain it, or load it with the release that wrote it"
                )
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if metadata["sha256"] != _digest(metadata["config"], state):
            raise ValueError("its digest is not that of its contents; copy it anew, or retrain it")
        config = json.loads(metadata["config"])
        if not isinstance(config, dict):
            raise ValueError("its configuration is no JSON object")
        return config, state
    except FileNotFoundError:
        raise
    except (SafetensorError, ValueError, KeyError, OSError, RecursionError) as error:
        raise ValueError(f"{path} is no checkpoint of rfl_torch: {error}") from None


def check_layout(state: Mapping[str, torch.Tensor], layout: Layout) -> dict[str, int]:
    """Make sure of every tensor's type, number of dimensions and sizes; all numbers are finite.

    Returns:
        The size behind each letter. None is zero unless a tensor says so.

    Raises:
        KeyError: if a tensor is missing.
        ValueError: if one doesn't fit the others.
    """
    sizes: dict[str, int] = {}
    for name, (dtype, letters) in layout.items():
        tensor = state[name]
        if tensor.dtype != dtype or tensor.ndim != len(letters):
            raise ValueError(
                f"{name} is {tensor.dtype} of {tensor.ndim} dimensions, needs {dtype} of "
                f"{len(letters)}"
            )
        for letter, size in zip(letters, tensor.shape, strict=True):
            if sizes.setdefault(letter, size) != size:
                raise ValueError(
                    f"{name} has shape {tuple(tensor.shape)}, another tensor has {sizes[letter]} "
                    f"where it has {size}"
                )
        if dtype.is_floating_point and not tensor.isfinite().all():
            raise ValueError(f"{name} has a number that is not finite")
    return sizes


def check_index(name: str, index: torch.Tensor, size: int) -> None:
    """Make sure that all numbers of `index` lie in 0..size - 1.

    Raises:
        ValueError: if one doesn't.
    """
    if index.numel() and (int(index.min()) < 0 or int(index.max()) >= size):
        raise ValueError(
            f"{name} has numbers from {int(index.min())} to {int(index.max())}, needs 0 to "
            f"{size - 1}"
        )


def _digest(config: str, state: Mapping[str, torch.Tensor]) -> str:
    """Hash of all that a file holds."""
    digest = hashlib.sha256(config.encode())
    for name in sorted(state):
        tensor = state[name]
        digest.update(repr((name, str(tensor.dtype), tuple(tensor.shape))).encode())
        digest.update(tensor.flatten().view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _sync_folder(folder: Path) -> None:
    """Bring a rename to the disk, where the system has such a thing."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(descriptor)
    except OSError:
        pass  # some file systems refuse it for folders
    finally:
        os.close(descriptor)
