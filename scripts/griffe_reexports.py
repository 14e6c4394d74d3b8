"""For the API reference: what a package's `__init__` imports from this project is public, with or without `__all__`."""

from __future__ import annotations

import griffe

PACKAGES = ("refu_core", "msg_adapters")


class Reexports(griffe.Extension):
    """`from refu_core.sdf._exact import ExactSdf as ExactSdf` in `refu_core/sdf/__init__.py` is public."""

    def on_package(self, *, pkg: griffe.Module, **_: object) -> None:
        """Marks such names as public, in `pkg` and all packages below it."""
        for module in [pkg, *(one for one in pkg.modules.values() if not one.is_alias)]:
            for member in module.members.values() if module.is_init_module else ():
                if isinstance(member, griffe.Alias) and member.target_path.startswith(PACKAGES):
                    member.public = True
