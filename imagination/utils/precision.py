"""Numerical precision of networks: the names of Lightning, and `auto`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from imagination.utils.errors import check_choice

if TYPE_CHECKING:
    import torch

PRECISIONS = ("auto", "32-true", "bf16-mixed", "16-mixed")
"""Supported precisions. The others of Lightning change the type of the weights, but units cast inputs to float32."""


def resolved(requested: str) -> str:
    """Return Lightning's name of a precision; `auto` selects bfloat16 (twice as fast) if the hardware supports it.

    Raises:
        UserError: if it is not in `PRECISIONS`.
    """
    import torch

    check_choice("precision", requested, PRECISIONS)
    if requested != "auto":
        return requested
    if torch.cuda.is_available():
        native = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        capabilities = torch.cpu.get_capabilities()
        native = bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))
    return "bf16-mixed" if native else "32-true"


def autocast(requested: str, device: str) -> torch.autocast:
    """Return the autocast context of a precision; the weights stay float32.

    As in training, bfloat16 replaces float16 on a CPU.

    Args:
        requested: one of `PRECISIONS`.
        device: "cpu" or "cuda".
    """
    import torch

    precision = resolved(requested)
    half = torch.float16 if precision == "16-mixed" and device != "cpu" else torch.bfloat16
    return torch.autocast(device, half, enabled=precision != "32-true")
