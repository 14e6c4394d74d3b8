"""What a file is that isn't a body of SMPL's layout, and what to do about arrays of other shapes."""

from __future__ import annotations

from collections.abc import Collection

_OTHERS = {5: "FLAME's, a head", 16: "MANO's, a hand", 33: "SMAL's, an animal", 35: "SMAL's, an animal", 75: "SUPR's"}
"""Models of the same keys, by their number of joints."""


def of_keys(there: Collection[str], missing: list[str]) -> str:
    """The hint for a file that has the keys `there` and lacks `missing`; empty if there is none."""
    if "skin_template_v" in there:
        return ": it is SKEL's, whose bones aren't SMPL's joints; give SMPL's own file"
    if missing == ["f"] and "faces" in there:
        return ": SMPL's files call their faces f"
    if "weights" in missing and "shapedirs" in missing:
        return ": a mesh or a scan has no joints and no shapes; fit SMPL to it and give SMPL's own file"
    return ""


def of_tree(shape: tuple[int, ...]) -> str:
    """The hint for a `kintree_table` of a wrong shape; empty if there is none."""
    if len(shape) == 2 and shape[1] == 2:
        return ": transpose it"
    other = _OTHERS.get(shape[1], "") if len(shape) == 2 else ""
    return f": the file is {other}; give SMPL's own file" if other else ""


def n_rows(shape: tuple[int, ...]) -> int:
    """How many triples an array (N, 3) holds, or one that was transposed by mistake."""
    return shape[1] if len(shape) == 2 and shape[0] == 3 != shape[1] else shape[0]


def of_shape(shape: tuple[int, ...], wanted: tuple[int, ...]) -> str:
    """The hint for an array of another shape than `wanted`; empty if there is none."""
    flat = (wanted[0] * wanted[1], *wanted[2:])
    if shape == wanted[::-1]:
        return ": transpose it"
    if shape == flat:
        return f": reshape it to {wanted}"
    return f": transpose it, and reshape it to {wanted}" if shape == flat[::-1] else ""
