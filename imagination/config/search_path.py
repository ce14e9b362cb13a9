"""Search path of Hydra: the conf trees of the core and of plugins."""

from collections.abc import Iterator
from contextlib import contextmanager

import hydra
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin

from imagination.config.plugin_registry import activate, core_conf


class _SearchPath(SearchPathPlugin):
    """Search path that appends the conf trees of valid plugins to that of the core."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for plugin in activate():
            search_path.append(provider=f"plugin {plugin.name}", path=f"file://{plugin.conf}")


@contextmanager
def hydra_initialized() -> Iterator[None]:
    """Initialize Hydra with the conf trees of the core and of plugins, unless a command has done so."""
    if GlobalHydra.instance().is_initialized():
        yield
        return
    register_plugins()
    with hydra.initialize_config_dir(str(core_conf()), version_base="1.3"):
        yield


def register_plugins(*, launchers: bool = True) -> None:
    """Add the conf trees of plugins to the search path of Hydra.

    Args:
        launchers: whether Hydra searches the plugins for launchers of sweeps, which imports code of the plugins.
    """
    if launchers:
        activate()  # before Hydra searches the importable packages
    if _SearchPath not in Plugins.instance().discover(SearchPathPlugin):
        Plugins.instance().register(_SearchPath)
    # the only store is read-only, but --help would copy it for each of a hundred config groups
    setattr(ConfigStore, "__deepcopy__", lambda store, memo: store)  # noqa: B010  (unknown to mypy)
