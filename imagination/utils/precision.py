"""What networks compute in: Lightning's names of precisions, and `auto`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from imagination.utils.errors import check_choice

if TYPE_CHECKING:
    import torch

PRECISIONS = ("auto", "32-true", "bf16-mixed", "16-mixed")
"""Lightning's others change the weights' type; units bring what they are given to float32."""


def resolved(asked: str) -> str:
    """Lightning's name of a precision; `auto` takes bfloat16 where the hardware computes it, twice as fast.

    Raises:
        UserError: if it is none of `PRECISIONS`.
    """
    import torch

    check_choice("precision", asked, PRECISIONS)
    if asked != "auto":
        return asked
    if torch.cuda.is_available():
        native = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        able = torch.cpu.get_capabilities()
        native = bool(able.get("avx512_bf16") or able.get("amx_bf16"))
    return "bf16-mixed" if native else "32-true"


def answering(asked: str, device: str) -> torch.autocast:
    """A context in which networks on a device, "cpu" or "cuda", answer in a precision; their weights are float32.

    As in training, bfloat16 takes the place of float16 on a CPU.
    """
    import torch

    precision = resolved(asked)
    half = torch.float16 if precision == "16-mixed" and device != "cpu" else torch.bfloat16
    return torch.autocast(device, half, enabled=precision != "32-true")
