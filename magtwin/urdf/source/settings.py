"""Settings: YAML files beside a description, read as plain data that cannot grow without end."""

import yaml

ENTRIES = 10_000
"""Entries of one table, those that it merges from others among them."""


class Loader(yaml.SafeLoader):
    """YAML's safe types. A table that merges one twice, which merges one twice, and so on, is refused."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Merge the tables of `<<` into one."""
        super().flatten_mapping(node)
        if len(node.value) > ENTRIES:
            raise yaml.constructor.ConstructorError(
                None, None, f"a table of over {ENTRIES} entries", node.start_mark
            )
