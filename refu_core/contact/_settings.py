"""Every tuned number of collision handling: its unit and what it is for, in one place."""

from __future__ import annotations

from dataclasses import dataclass

from refu_core.refu import MAX_DISPLACEMENT


@dataclass(frozen=True, kw_only=True)
class ContactSettings:
    """How a garment is brought off the body and off the garments below it.

    Each number says what it is for. `benchmarks/contact.py` measures what half and twice of it do on recorded motion.
    """

    # Pushes along the gradient
    max_displacement: float = MAX_DISPLACEMENT
    """No vertex moves farther than this, however wrong its distance is [m]."""
    max_pushes: int = 4
    """Pushes of a vertex, and rounds of raised edges."""
    tolerance: float = 2e-4
    """What may be missing to the margin [m]."""

    # Distances that contradict each other along an edge
    contradiction: float = 1e-3
    """Disagreement that is tolerated [m]: an approximate distance is never quite consistent."""
    looks: int = 3
    """How far a search goes from the rim of a patch of wrong closest faces into it [edges]."""
    cuts: int = 8
    """How far a search goes from the rim of a patch of wrong sides into it [edges]."""

    # Vertices in the middle of a limb
    deep: float = 0.008
    """From this depth on, the shortest way out may be through the other side of the limb [m]."""
    turns: int = 8
    """Steps of a search along the cloth's own normal."""
    step_on: float = 1e-3
    """Added to each step of a search or a retreat, so that they end [m]."""
    farthest: float = 0.08
    """A way out along the cloth's normal is no longer than this [m]."""
    detour: float = 2.0
    """Nor is it longer than this multiple of the depth. Such cloth has been folded, and its normal would lead a single
    vertex through a whole thigh, centimetres past all others."""
    turning: float = 0.5
    """This many depths before the longest detour, the way begins to turn from the normal to the shortest one.
    It turns by degrees: with a hard limit vertices leapt from frame to frame."""

    # Limbs that a vertex doesn't lie on
    own_weight: float = 0.02
    """A vertex lies on every limb that has more than this of its skinning weight: at the armpit, on trunk and arm."""
    sideways: float = -0.3
    """Cosine of push and outward normal above which a push leads around a limb, and no longer back from it."""
    inward: float = 0.15
    """A limb that pushes a smaller share of the vertices at it inwards lies under the cloth."""
    retreats: int = 8
    """Steps of a retreat from a limb."""

    # Neighbours
    blend_reach: int = 2
    """How far the neighbourhood reaches that gives way with a pushed vertex [edges]. Farther out nothing collides, and
    moving it makes nothing truer."""
    blend_steps: tuple[float, float] = (3.0, 0.75)
    """How far the two sweeps of a pair go towards the mean of the neighbours. The long step levels what is wide, the
    short one the ripples that the long one overdoes (Richardson). A pair leaves at most 0.6 of any ripple."""
    blend_pairs: int = 3
    """Pairs of sweeps. Three do what twelve plain means do."""
    sure: float = 4e-3
    """How far beyond the margin a distance is trusted [m]. Where a body runs into itself the distance jumps: a vertex
    within an arm may seem to be 2 cm outside of the flank that the arm is in."""

    # Edges
    bulge: float = 0.375
    """How far skin is expected to bulge towards the middle of an edge, per length of the edge and per radian between
    the normals below its ends: three times as far as a circle does."""
    through: float = 0.005
    """An edge whose middle lacks up to this is raised in full, and one that lacks twice as much not at all [m]. An edge
    that lacks more runs through a limb, and raising it would throw its ends into another one."""

    # Garments over each other
    layer_gap: float = 0.003
    """How far apart two garments are kept [m]: their triangles cut the corners between vertices."""
    layer_reach: float = 0.03
    """How far the sheet below is felt [m], less and less in the last quarter. Only cloth in a fold is deeper, and which
    side of the fold is closest changes from frame to frame."""
    layer_later_reach: float = 0.02
    """The same of the second push, which is a correction [m]."""
    layer_meets: float = 0.1
    """Vertices farther than this from the other garment at rest don't meet it in any pose [m]."""
    layer_fade: float = 0.02
    """How far beyond its open rims a sheet is still felt, less and less [m]: cloth runs smoothly over a waistband."""
    layer_agreement: float = 0.25
    """Cosine of the garments' normals from which on a push counts in full; at a right angle it doesn't count at all."""
    layer_doubt: float = 0.012
    """A search that ends this far below the sheet may have found another fold, so a tree is asked [m]."""
    layer_stretch: float = 1.5
    """Edges of the sheet below that are longer than this multiple of their rest length aren't searched along."""
    layer_spacing: float = 0.05
    """How far the places on a sheet are apart from which the closest one is looked for [m]."""
    layer_slides: float = 0.14
    """Places up to this far away at rest are among them [m]: so far garments slide, and folds come near."""
    layer_rounds: int = 6
    """How far the neighbourhood of a push reaches [edges], and how often it is swept. Even: the field ends where it
    began."""
    layer_later_rounds: int = 2
    """The same of the second push."""


DEFAULT_CONTACT = ContactSettings()
