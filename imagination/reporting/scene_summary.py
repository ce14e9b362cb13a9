"""Summary and labelled sample views of one scene."""

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
    """Sides of the square dilation kernels of V_filter and M*_seen, cells."""

    imaginable: int
    neighbourhood: int


def summary(scene: Scene, gt: GroundTruth, categories: CategoryTable) -> list[str]:
    """Return lines on the content of the scene and its ground truth."""
    cell = gt.grid.resolution**2
    free = scene.free_space.mask.sum() * scene.free_space.grid.resolution**2
    lines = [f"{scene.name}: {len(scene.mesh.faces)} triangles, {free:.1f} m2 free, {len(gt.points)} points"]
    for layer, name in enumerate(categories.names):
        count, area = len(scene.of_category(name)), gt.truth[layer].sum() * cell
        overlap = gt.truth[layer] & np.delete(gt.truth, layer, axis=0).any(axis=0)
        fraction = overlap.sum() / max(gt.truth[layer].sum(), 1)
        lines.append(
            f"{name}: {count} objects, {area:.2f} m2 of ground truth, {fraction:.1%} of it also of another category"
        )
    return lines


def choose_views(
    observer: Observer, name: str, poses: int, seed: int, kernels: Kernels
) -> list[LabelledView]:
    """Draw random views and return the one with the largest label for each category."""
    rng = np.random.default_rng(seed)
    scene = observer.scene(name)
    views = [observer.observe(name, pose, rng) for pose in sample_poses(scene.free_space, poses, rng)]
    sizes = np.array(
        [label(view.object, view.seen[None], kernels.imaginable).sum(axis=(1, 2)) for view in views]
    )
    renderer = renderer_of(scene)
    selected = []
    for layer in range(len(observer.categories)):
        best = int(sizes[:, layer].argmax())
        sizes[best] = -1  # no view twice, if there are enough
        selected.append(label_view(views[best], layer, observer, renderer, scene.floor_height, kernels))
    return selected


def label_view(
    view: View, layer: int, observer: Observer, renderer: SceneRenderer, floor: float, kernels: Kernels
) -> LabelledView:
    """Compute all maps and labels of a view for one category."""
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
    """Return views as arrays with a leading axis."""
    return {
        field: np.stack([np.asarray(getattr(view, field)) for view in views])
        for field in LabelledView._fields
    }
