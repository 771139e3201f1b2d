"""Save and load a model as one safetensors file; nothing in it can run code."""

import json
import os
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

FORMAT = "rfl_torch/1"


def save_checkpoint(path: Path, config: dict[str, Any], state: dict[str, torch.Tensor]) -> None:
    """Write `state` with the plain-JSON `config` that rebuilds the module around it.

    The file is written beside its place and renamed, so a crash leaves the old one whole.
    """
    tensors = {name: tensor.detach().contiguous() for name, tensor in state.items()}
    new = path.with_name(path.name + ".new")
    try:
        save_file(tensors, new, metadata={"format": FORMAT, "config": json.dumps(config)})
        os.replace(new, path)
    finally:
        new.unlink(missing_ok=True)


def load_checkpoint(path: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Read back what `save_checkpoint` wrote.

    Raises:
        ValueError: naming the file, if it is cut short, altered, or of another format.
        FileNotFoundError: if there is no such file.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise ValueError(
                    f"holds format {metadata.get('format')!r}, this version reads {FORMAT!r}; "
                    "retrain it, or load it with the release that wrote it"
                )
            config = json.loads(metadata["config"])
            return config, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise
    except (SafetensorError, ValueError, KeyError, OSError) as error:
        raise ValueError(f"{path} is no checkpoint of rfl_torch: {error}") from None
