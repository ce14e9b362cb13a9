"""Options of the group `extras`: printing of the config, and warnings."""

import warnings

from omegaconf import DictConfig, OmegaConf
from rich.syntax import Syntax
from rich.tree import Tree

from imagination.utils.progress import console


def apply_extras(config: DictConfig) -> None:
    """Apply the options in `config.extras` at the start of a command."""
    if config.extras.ignore_warnings:
        warnings.simplefilter("ignore")
    if config.extras.print_config:
        console.print(config_tree(config))


def config_tree(config: DictConfig) -> Tree:
    """Return a tree with one branch for each node of a config."""
    tree = Tree("config")
    for name in config:
        node = OmegaConf.select(config, str(name), throw_on_missing=False)
        text = OmegaConf.to_yaml(node).rstrip() if OmegaConf.is_config(node) else str(node)
        tree.add(str(name)).add(Syntax(text, "yaml", background_color="default"))
    return tree
