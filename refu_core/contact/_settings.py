"""Every tuned number of collision handling: its unit and what it is for, in one place."""

from __future__ import annotations

import math
from dataclasses import dataclass

from refu_core.errors import MeshError
from refu_core.refu import MAX_DISPLACEMENT


@dataclass(frozen=True, kw_only=True)
class ContactSettings:
    """How a garment is brought off the body and off the garments below it.

    Each number says what it is for, and what follows from it is a property. `benchmarks/sensitivity.py` measures what
    half and twice of it do.
    """

    max_displacement: float = MAX_DISPLACEMENT
    """No vertex moves farther than this, however wrong its distance is [m]. Cloth that is this far at rest from a
    garment that it is worn with lies on it; the rest may come beside it, as a sleeve does beside shorts. Folds farther
    than twice this from it are left alone: unfolded everywhere, vertices' mean error grows by 0.2 mm."""
    max_pushes: int = 4
    """Pushes of a vertex, rounds of raised edges, partings of garments that cut each other, and how many edges far a
    search goes from the rim of a patch of wrong closest faces into it."""
    gap: float = 0.004
    """How far apart two garments are kept, how far before a limb that comes between it and its skin cloth stays (half
    way where there is less room), and how far triangles that cut each other go in one sweep [m]: they cut the corners
    between vertices. With half of it 2.6 % of frames of shirt and shorts are cut (none). An edge whose middle lacks up
    to this is raised in full, and one that lacks twice as much not at all: it runs through a hand. Were it raised, a
    T-shirt on limbs that run through the trunk would lie 40 mm elsewhere, not 5, when the person turns."""
    near: int = 2
    """How far around a pushed vertex cloth goes along [edges]. Farther out nothing collides, and moving it makes
    nothing truer; fingers are thinner than a garment's edges are long."""
    around: int = 6
    """How far around a push off a garment below, a limb or a fold cloth gives way, less and less, and how often it is
    smoothed there [edges]. Even: what is swept ends where it began."""
    levellings: int = 48
    """How often cloth that is folded over is levelled. Even. Of 343 recorded frames of a T-shirt over shorts 16 leave
    2.3 % cut, 32 and 48 leave 0.3 %, 100 none. With 48 a T-shirt jumps by more than 20 mm in 1.7 % of frame pairs (its
    network alone in 1.2), with 100 in 2.9 %."""
    limb_reach: float = 0.08
    """How far beside a limb cloth still feels it, less and less [m]: a hand that swings goes 30 mm in a frame. Near
    its skin cloth feels it from less far: twice its height squared, divided by this. Up to this height cloth lies on
    its skin; at twice the height it doesn't, since there neighbours lie on different legs, and pressed to them they
    tear. With 70 mm a skirt jumps by more than 40 mm in 1.5 % of 343 recorded frame pairs, with 80 mm in 0.9 %; its
    error is 6.9 and 7.0 mm. Cloth whose networks know where arms are (`Wearable.knows_arms`) feels limbs as far as one
    of its edges is long: what those predict is nearer to the truth than where a limb from afar draws it."""
    strain_limit: float = 1.6
    """How many times their rest length edges may be, unless they were predicted longer, before their ends are drawn
    together. In 116 recorded frames .0016 % of a skirt's edges are twice as long as at rest, and .026 % with a limit of
    3.2. Some edge of a T-shirt is longer in 33 % of frames, which then cost a push more; with a limit of 1.4 in 48 %,
    with 1.25 in 96 %, for as many crossings and jumps."""
    alike: float = 0.5
    """Cosine from which on two sheets face alike; at a right angle they don't at all. So much does a push off a garment
    below count, and so much is cloth left as it is that faces where skinning turns it: what faces elsewhere has folded
    over, and is levelled. Of 20 frames that all are cut without that, this leaves 2; levelled from 0.25 on, 7."""
    layer_margin: float = 0.5
    """Share of the body's margin that is left once a garment was brought off those below it again: what pushes a vertex
    off the body may push it into a layer, and the other way round. Both have this much to give."""
    layer_reach: float = 0.03
    """How far the sheet below is felt [m], less and less in the last quarter, and beyond its open rims; as far apart
    are the places on it from which the closest one is looked for. Only cloth in a fold is deeper, and which side
    of the fold is closest changes from frame to frame."""

    def __post_init__(self) -> None:
        """Raises `MeshError` for a gap of nothing, which looks go on by, and for numbers that have to be even."""
        if not self.gap > 0 or self.around % 2 or self.levellings % 2:
            given = f"{self.gap}, {self.around} and {self.levellings}"
            msg = f"wanted a gap of more than 0 m, and even numbers for around and levellings, got {given}"
            raise MeshError(msg)

    @property
    def tolerance(self) -> float:
        """What may be missing to the margin, how far apart triangles that cut each other are brought, and by how much
        more than their edge is long distances at its ends may differ before one of them is doubted [m].
        """
        return self.gap / 20

    @property
    def sweeps(self) -> int:
        """How often edges that were torn apart, and triangles that cut each other, are drawn to where they should be.

        What one of them moves has then come as far as cloth gives way, and back.
        """
        return 2 * self.around

    @property
    def blend_steps(self) -> tuple[float, float]:
        """How far the two sweeps of a pair go towards the mean of the neighbours: Chebyshev's for two steps.

        They level ripples from the finest that triangles carry, which a whole step turns over by half, to those
        as wide as cloth gives way on both sides. The long one levels what is wide, and the short one the ripples that
        the long one overdoes.
        """
        finest, widest = 1.5, (math.pi / (2 * max(self.around, 1))) ** 2
        middle, half = (finest + widest) / 2, (finest - widest) / 2 * math.sqrt(0.5)
        return 1 / (middle - half), 1 / (middle + half)

    @property
    def fade(self) -> float:
        """What is left from edge to edge of how much cloth gives way."""
        return 1 - 1 / max(self.around, 1)

    @property
    def parting_most(self) -> float:
        """How far garments that cut each other are parted at most [m]: so far cloth leaps that cuts in one frame alone.

        Without a limit T-shirts leap by 53 mm.
        """
        return self.max_pushes * self.gap


DEFAULT_CONTACT = ContactSettings()
