"""Reading of stored configurations, which somebody may have altered."""

from pathlib import Path

import yaml  # type: ignore[import-untyped]

from ssm_study.durable import read_limited_bytes
from ssm_study.refusal import BadRequest, require

LARGEST_YAML = 2**22  # bytes of a configuration that is read: a real one has 4,000
MOST_VALUES = 100_000  # in a configuration: a real one has 200


def read_stored_yaml(path: Path) -> str:
    """Read the text of a YAML file in a results folder.

    Raises `BadRequest` for text that is no YAML, and for one with interpolations or very many
    aliases, before they are expanded: 500 bytes of them can fill any memory.
    """
    field = "/".join(path.parts[-2:])
    remedy = "run the study again"
    try:
        text = read_limited_bytes(path, LARGEST_YAML).decode()
        loader = yaml.CSafeLoader(text)
        try:
            tree = loader.get_single_node()
        finally:
            loader.dispose()
        count = 0 if tree is None else _count_values(tree, {})
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise BadRequest(field, path, f"cannot be read ({error})", remedy) from error
    require(count <= MOST_VALUES, field, path, f"aliases make {count:.0e} values of it", remedy)
    problem = "contains ${...}, which a stored configuration never does"
    require("${" not in text, field, path, problem, remedy)
    return text


def _count_values(node: yaml.Node, counted: dict[int, int]) -> int:
    """Number of values in a YAML document after its aliases are expanded."""
    if id(node) in counted:
        return counted[id(node)]
    counted[id(node)] = MOST_VALUES + 1  # for a node that contains itself
    children = node.value if isinstance(node, yaml.CollectionNode) else []
    if isinstance(node, yaml.MappingNode):
        children = [part for pair in children for part in pair]
    counted[id(node)] = 1 + sum(_count_values(child, counted) for child in children)
    return counted[id(node)]
