"""Loading of weights, and selection of the torch device."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from vio.errors import ConfigError, DataError

if TYPE_CHECKING:
    import torch

Module: TypeAlias = "torch.nn.Module"

SECTION = "frontend.learned"  # of the configuration, for messages


def pick_device(name: str) -> torch.device:
    """The torch device of a setting, "cpu" or "cuda".

    Raises:
        ConfigError: CUDA is requested but absent.
    """
    import torch

    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            f"{SECTION}.device is cuda, but torch finds no CUDA device here; set it to cpu"
        )
    return torch.device(name)


def half_precision(device: torch.device) -> Any:
    """Context for half precision on CUDA; no change on other devices."""
    import torch

    return torch.autocast("cuda", dtype=torch.float16, enabled=device.type == "cuda")


def load_weights(path: Path | None, setting: str) -> dict[str, Any]:
    """Read a file of weights; the entry "state_dict" where there is such a key.

    Args:
        path: the file; None raises an error with the name of the setting.
        setting: name of the setting in `frontend.learned`, for messages.

    Raises:
        ConfigError: no file is set.
        DataError: the file cannot be read as weights.
    """
    import torch

    if path is None:
        raise ConfigError(
            f"{SECTION}.{setting} is not set; give the path of a file of weights (none is "
            "downloaded)"
        )
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, ValueError, KeyError, pickle.UnpicklingError) as error:
        reason = str(error).strip().split("\n", 1)[0][:120]
        raise DataError(
            f"{path} ({SECTION}.{setting}) cannot be read as weights of torch: {reason}; give a "
            ".pth file"
        ) from error
    for key in ("state_dict", "extractor", "model"):
        if isinstance(content, dict) and isinstance(content.get(key), dict):
            content = content[key]
    if not isinstance(content, dict):
        raise DataError(
            f"{path} ({SECTION}.{setting}) holds no named weights; give a .pth file of a state dict"
        )
    return dict(content)


def filled(module: Any, path: Path | None, setting: str) -> Module:
    """Load all weights of a module from a file, for inference."""
    state = load_weights(path, setting)
    try:
        result = module.load_state_dict(state, strict=False)
        # Buffers that the constructor computes need not be in the file; learned parameters must be.
        learned = dict(module.named_parameters()).keys() | {
            k for k in module.state_dict() if k.endswith("running_var")
        }
        wrong = sorted(set(result.missing_keys) & learned) + sorted(result.unexpected_keys)
        problem = None
        if wrong:
            problem = f"{len(wrong)} entries do not fit, such as {wrong[0]}"
    except (RuntimeError, TypeError, AttributeError) as error:
        problem = " ".join(str(error).split())[:140]
    if problem is not None:
        raise DataError(
            f"{path} ({SECTION}.{setting}) holds weights of another network than "
            f"{type(module).__name__} ({problem}); "
            "give the file that belongs to it"
        )
    return module.eval()
