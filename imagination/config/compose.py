"""Compose configurations from the core's conf tree and those of plugins."""

import hydra
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig

from imagination.config.plugin_registry import activate, core_conf


class _SearchPath(SearchPathPlugin):
    """Lets Hydra find the conf trees of sound plugins, after the core's."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for plugin in activate():
            search_path.append(provider=f"plugin {plugin.name}", path=f"file://{plugin.conf}")


def compose(config_name: str, overrides: list[str]) -> DictConfig:
    """Compose a config as a command would, from a script or inside another command."""
    if GlobalHydra.instance().is_initialized():
        return hydra.compose(config_name, overrides)
    register_plugins()
    with hydra.initialize_config_dir(str(core_conf()), version_base="1.3"):
        return hydra.compose(config_name, overrides)


def register_plugins() -> None:
    """Let Hydra find the conf trees of plugins."""
    activate()  # before Hydra looks for launchers among what can be imported
    if _SearchPath not in Plugins.instance().discover(SearchPathPlugin):
        Plugins.instance().register(_SearchPath)
    # there is one store and it is only read, but --help would copy it for each of a hundred config groups
    setattr(ConfigStore, "__deepcopy__", lambda store, memo: store)  # noqa: B010  (mypy knows no such method)
