"""Registration of classes of one kind, which are found by name in the files of a folder. Each
member of a family is one file in the folder of the family; members are found by their names,
without a list."""

import pkgutil
from abc import ABC
from importlib import import_module
from types import ModuleType
from typing import Any, ClassVar

from ssm_study.extensions import import_trusted_packages


class Family(ABC):
    """Base class of a set of interchangeable classes, which registers each of its subclasses by
    name. `class Reader(Family)`, then `class Csv(Reader, names=(".csv",))` in a file of the
    family's room.

    The definition of a member that lacks an abstract method of its family raises `TypeError`.
    Members outside the folder count once their module is imported. A member with a single name has
    it as `kind`.
    """

    known: ClassVar[dict[str, type[Any]]]
    kind: ClassVar[str | None]

    def __init_subclass__(cls, names: tuple[str, ...] = (), **others: Any) -> None:
        super().__init_subclass__(**others)
        if Family in cls.__bases__:
            cls.known = {}
        left_open = sorted(
            n
            for n in dir(cls)
            if getattr(getattr(cls, n, None), "__isabstractmethod__", False)
            and getattr(getattr(cls, n), "__name__", n) == n  # no old name of a method
        )
        if names and left_open:
            raise TypeError(f"{cls.__name__} does not answer {', '.join(left_open)}")
        cls.known.update(dict.fromkeys(names, cls))
        if len(names) == 1:
            cls.kind = names[0]

    @classmethod
    def members(cls, package: ModuleType) -> dict[str, type[Any]]:
        """Registered subclasses by name, after the import of every file that may define one."""
        import_trusted_packages()
        for module in pkgutil.iter_modules(package.__path__):
            import_module(f"{package.__name__}.{module.name}")
        return cls.known
