"""Summary and sample views of one scene."""

from typing import NamedTuple

import numpy as np

from imagination.ground_truth.scene_maps import GroundTruth
from imagination.ground_truth.targets import imaginable_mask, label, neighbourhood
from imagination.ground_truth.visualization import LabelledView
from imagination.scenes.categories import CategoryTable
from imagination.scenes.renderer import SceneRenderer, renderer_of
from imagination.scenes.scene import Scene
from imagination.views.observer import Observer
from imagination.views.pose_samplers import sample_poses
from imagination.views.view import View


class Kernels(NamedTuple):
    """Sides of the squares that make V_filter and M*_seen, cells."""

    imaginable: int
    neighbourhood: int


def summary(scene: Scene, truth: GroundTruth, categories: CategoryTable) -> list[str]:
    """What the scene contains, and how much of it is in the ground truth."""
    cell = truth.grid.resolution**2
    free = scene.free_space.mask.sum() * scene.free_space.grid.resolution**2
    lines = [
        f"{scene.name}: {len(scene.mesh.faces)} triangles, {free:.1f} m2 free, {len(truth.points)} points"
    ]
    for layer, name in enumerate(categories.names):
        count, area = len(scene.of_category(name)), truth.truth[layer].sum() * cell
        shared = truth.truth[layer] & np.delete(truth.truth, layer, axis=0).any(axis=0)
        share = shared.sum() / max(truth.truth[layer].sum(), 1)
        lines.append(
            f"{name}: {count} objects, {area:.2f} m2 of truth, {share:.1%} of it also another category's"
        )
    return lines


def choose_views(
    observer: Observer, name: str, poses: int, seed: int, kernels: Kernels
) -> list[LabelledView]:
    """Of random views, for each category the one with the largest label."""
    rng = np.random.default_rng(seed)
    scene = observer.scene(name)
    views = [observer.observe(name, pose, rng) for pose in sample_poses(scene.free_space, poses, rng)]
    sizes = np.array(
        [label(view.object, view.seen[None], kernels.imaginable).sum(axis=(1, 2)) for view in views]
    )
    renderer = renderer_of(scene)
    chosen = []
    for layer in range(len(observer.categories)):
        best = int(sizes[:, layer].argmax())
        sizes[best] = -1  # no view twice, where there are enough
        chosen.append(develop(views[best], layer, observer, renderer, scene.floor_height, kernels))
    return chosen


def develop(
    view: View, layer: int, observer: Observer, renderer: SceneRenderer, floor: float, kernels: Kernels
) -> LabelledView:
    """Everything that becomes of a view for one category."""
    objects = view.object[layer]
    image = renderer.render(observer.camera, observer.camera.to_world(view.pose, floor))
    return LabelledView(
        view.pose,
        layer,
        view.rgb,
        view.depth,
        image.instance,
        view.occupied,
        view.seen,
        objects,
        imaginable_mask(objects, view.seen, kernels.imaginable),
        label(objects, view.seen, kernels.imaginable),
        neighbourhood(objects, view.seen, kernels.neighbourhood),
    )


def stack(views: list[LabelledView]) -> dict[str, np.ndarray]:
    """Views as arrays with a leading axis."""
    return {
        field: np.stack([np.asarray(getattr(view, field)) for view in views])
        for field in LabelledView._fields
    }
