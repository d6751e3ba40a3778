"""Stand-ins for libraries that take long to import, for a process that only prints help.

The help of a command is made of signatures, defaults and docstrings. To read these, the modules of the
command must be imported. They import libraries, which takes seconds, but no function of a library is called.
"""

import sys
from collections.abc import Sequence
from importlib.abc import Loader
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

_LIBRARIES = (
    *("PIL", "cv2", "h5py", "jaxtyping", "matplotlib", "networkx", "numpy", "poselib"),
    *("pycolmap", "rich", "scipy", "threadpoolctl", "trimesh"),
)


def replace_libraries() -> None:
    """Make every import of these libraries, from now on, give a stand-in."""
    sys.meta_path.insert(0, _Finder())


class _Anything(type):
    """A class that gives itself for every attribute, item, call and operation."""

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return cls

    def __getitem__(cls, _key: Any) -> Any:
        return cls

    def __call__(cls, *_arguments: Any, **_options: Any) -> Any:
        return cls

    def _operate(cls, _other: Any = None) -> Any:
        return cls

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __truediv__ = __rtruediv__ = _operate
    __pow__ = __rpow__ = __matmul__ = __neg__ = _operate


class _StandIn(metaclass=_Anything):
    pass


class _Module(ModuleType):
    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _StandIn


class _Finder(Loader):
    """Finds and loads the stand-ins."""

    def find_spec(
        self, name: str, _path: Sequence[str] | None = None, _target: ModuleType | None = None
    ) -> ModuleSpec | None:
        is_replaced = name.partition(".")[0] in _LIBRARIES
        return ModuleSpec(name, self, is_package=True) if is_replaced else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return _Module(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        pass
