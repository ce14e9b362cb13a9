"""HRNetV2 with weights trained on ADE20K, in the layout of a public release.

The user provides the weights in the layout of ade20k-hrnetv2-c1 from
github.com/CSAILVision/semantic-segmentation-pytorch: one folder with encoder_*.pth and decoder_*.pth, state dicts of
HRNetV2-W48 and of its `c1` decoder for the 150 classes of the MIT Scene Parsing Benchmark (Zhou et al. 2017, Scene
Parsing through ADE20K Dataset). The category table assigns classes to categories with `aliases.ade20k`
(conf/categories).
"""

from collections.abc import Mapping
from pathlib import Path

import torch
from jaxtyping import UInt8
from torch import Tensor, nn

from imagination.geometry.camera import Camera
from imagination.models.segmentation.hrnet import HRNetV2, at_size
from imagination.models.task_kind import TaskKind
from imagination.models.tta_hflip import average_with_hflip
from imagination.models.weights import mismatches
from imagination.scenes.categories import CategoryTable
from imagination.utils.errors import UserError

SOURCE = "ade20k"

SHORTER_SIDE = 450
"""Shorter side to which images are enlarged, pixels: the middle of the release's test sizes, 300 to 600."""

CLASSES = tuple(
    """wall building sky floor tree ceiling road bed windowpane grass cabinet sidewalk person earth door table
    mountain plant curtain chair car water painting sofa shelf house sea mirror rug field armchair seat fence desk rock
    wardrobe lamp bathtub railing cushion base box column signboard chest_of_drawers counter sand sink skyscraper
    fireplace refrigerator grandstand path stairs runway case pool_table pillow screen_door stairway river bridge
    bookcase blind coffee_table toilet flower book hill bench countertop stove palm kitchen_island computer
    swivel_chair boat bar arcade_machine hovel bus towel light truck tower chandelier awning streetlight booth
    television airplane dirt_track apparel pole land bannister escalator ottoman bottle buffet poster stage van ship
    fountain conveyer_belt canopy washer plaything swimming_pool stool barrel basket waterfall tent bag minibike cradle
    oven ball food step tank trade_name microwave pot animal bicycle lake dishwasher screen blanket sculpture hood
    sconce vase traffic_light tray ashcan fan pier crt_screen plate monitor bulletin_board shower radiator glass clock
    flag""".split()
)
"""Classes of the benchmark, in the order of the network's outputs."""

LEFT_OUT = ("num_batches_tracked", "_tmp_running_mean", "_tmp_running_var", "_running_iter")
"""Suffixes of entries that only training uses, including those of the release's batch normalisation."""

DECODER = {"cbr.": "decoder.0.", "conv_last.": "decoder.1."}
"""Prefixes of the `c1` decoder's weights in the release, and our prefixes."""


class PublicHRNet(nn.Module):
    """HRNetV2-W48 for the classes of ADE20K, which predicts categories of the category table.

    Args:
        table: category table, which assigns classes to categories.
        camera: camera of the images.
        tta_hflip: whether to use horizontal-flip test-time augmentation.

    Raises:
        UserError: if a category lists a class that does not exist, or no category lists any class.
    """

    kind = TaskKind.IMAGES
    category_of_class: Tensor

    def __init__(self, table: CategoryTable, camera: Camera, tta_hflip: bool = False) -> None:
        super().__init__()
        self.tta_hflip = tta_hflip
        self.categories = [row.name for row in table if row.aliases.get(SOURCE)]
        if not self.categories:
            raise UserError(
                f"categories: got no row with aliases.{SOURCE}, expected the classes that belong to a category"
            )
        category_of_class = torch.zeros(len(CLASSES), dtype=torch.uint8)
        for index, name in enumerate(self.categories):
            for label in table.rows[table.index(name) - 1].aliases[SOURCE]:
                if label not in CLASSES:
                    raise UserError(
                        f"categories.{name}.aliases.{SOURCE}: got {label!r}, expected classes among: "
                        f"{', '.join(CLASSES)}"
                    )
                category_of_class[CLASSES.index(label)] = index + 1
        self.register_buffer("category_of_class", category_of_class, persistent=False)
        enlarge = max(1.0, SHORTER_SIDE / min(camera.width, camera.height))
        self.network = HRNetV2("hrnet_w48", len(CLASSES), enlarge)

    @classmethod
    def load(
        cls, folder: Path, table: CategoryTable, camera: Camera, tta_hflip: bool = False
    ) -> "PublicHRNet":
        """Load the network with the weights in a folder, in evaluation mode on the CPU.

        Raises:
            UserError: if files are missing or damaged, or hold weights of another architecture.
        """
        model = cls(table, camera, tta_hflip)
        encoder, decoder = (read(folder, part) for part in ("encoder", "decoder"))
        fill(model.network, renamed(encoder, decoder), folder)
        return model.eval()

    @torch.no_grad()
    def segment(
        self, rgb: UInt8[Tensor, "b 3 h w"], rows: int, columns: int
    ) -> UInt8[Tensor, "b rows columns"]:
        """Return the most probable category of each pixel: 0 for background, else category index + 1.

        The probabilities of the classes of one category (chair, armchair, swivel chair) are added and compared with the
        most probable class that belongs to no category.
        """
        rgb = rgb.to(self.category_of_class.device)
        logits = average_with_hflip(self.network, rgb) if self.tta_hflip else self.network(rgb)
        probabilities = at_size(logits, rows, columns).softmax(dim=1)
        background = probabilities[:, self.category_of_class == 0].amax(dim=1, keepdim=True)
        foreground = [
            probabilities[:, self.category_of_class == index + 1].sum(dim=1, keepdim=True)
            for index in range(len(self.categories))
        ]
        return torch.cat([background, *foreground], dim=1).argmax(dim=1).to(torch.uint8)


def read(folder: Path, part: str) -> dict[str, Tensor]:
    """Read the state dict in the folder's encoder_*.pth or decoder_*.pth.

    Raises:
        UserError: if there is not exactly one such file, or it holds anything but named tensors.
    """
    paths = sorted(folder.glob(f"{part}_*.pth"))
    if len(paths) != 1:
        names = ", ".join(path.name for path in paths) or "none"
        raise UserError(f"ade20k: got {names} in {folder}, expected one file {part}_*.pth")
    try:
        state = torch.load(paths[0], map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises various exceptions on a damaged file
        raise UserError(
            f"ade20k: {paths[0]} cannot be read: it is truncated or holds more than weights; download it again"
        ) from error
    if not isinstance(state, dict) or not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in state.items()
    ):
        raise UserError(f"ade20k: {paths[0]} holds no state dict, expected named tensors; download it again")
    return state


def renamed(encoder: Mapping[str, Tensor], decoder: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Rename the release's weights to the names of our network; unknown names stay as they are."""
    weights = {}
    for part, state in (("encoder", encoder), ("decoder", decoder)):
        for name, tensor in state.items():
            name = name.removeprefix("module.")
            if name.endswith(LEFT_OUT):
                continue
            known = {"": "encoder."} if part == "encoder" else DECODER
            prefix = next((prefix for prefix in known if name.startswith(prefix)), None)
            weights[name if prefix is None else known[prefix] + name.removeprefix(prefix)] = tensor
    return weights


def fill(network: nn.Module, weights: Mapping[str, Tensor], origin: Path) -> None:
    """Load weights by name.

    Args:
        network: network to load the weights into.
        weights: weights by the network's names.
        origin: folder of the weights, for the error message.

    Raises:
        UserError: if names or shapes differ.
    """
    expected = {name: value for name, value in network.state_dict().items() if not name.endswith(LEFT_OUT)}
    if differences := mismatches(weights, expected):
        raise UserError(
            f"ade20k: the weights in {origin} are of another architecture, expected HRNetV2-W48 with the c1 decoder "
            f"and {len(CLASSES)} classes; {differences}"
        )
    network.load_state_dict(dict(weights), strict=False)  # the counters of LEFT_OUT are missing
