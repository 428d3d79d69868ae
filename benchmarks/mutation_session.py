"""Lists faults of chosen kinds, in Cosmic Ray's environment: `python mutation_session.py CONFIG
SESSION PATTERN`.

Cosmic Ray's own `init` lists every kind it knows, six times as many as `mutation.py` plants, and
takes as much longer: it walks over every module once for each kind.
"""

import re
import sys
from functools import cache

import cosmic_ray.commands.init
import cosmic_ray.plugins
from cosmic_ray.ast import ast_nodes
from cosmic_ray.cli import cli


def main(config: str, session: str, pattern: str) -> None:
    every_kind = cosmic_ray.plugins.operator_names()
    chosen = [name for name in every_kind if re.match(pattern, name)]
    cosmic_ray.plugins.operator_names = lambda: chosen
    names = vars(sys.modules["cosmic_ray.commands.init"])  # the function has the module's name
    names["ast_nodes"] = cache(lambda tree: list(ast_nodes(tree)))
    cli.main(["init", config, session])


if __name__ == "__main__":
    main(*sys.argv[1:])
