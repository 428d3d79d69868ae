"""Tells Hydra where the yaml files of trusted packages lie; read at each start, so nothing
heavy."""

from hydra.core.config_search_path import ConfigSearchPath
from hydra.plugins.search_path_plugin import SearchPathPlugin

from ssm_study.extensions import extension_configuration_folders


class ExtensionsSearchPath(SearchPathPlugin):
    """Theirs come after ours: no other package can change what a choice of ours means."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for folder in extension_configuration_folders():
            search_path.append(provider=folder.parent.name, path=f"file://{folder}")
