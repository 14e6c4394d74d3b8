"""Every tuned number of collision handling: its unit and what it is for, in one place."""

from __future__ import annotations

import math
from dataclasses import dataclass

from refu_core.errors import MeshError
from refu_core.refu import MAX_DISPLACEMENT


@dataclass(frozen=True, kw_only=True)
class ContactSettings:
    """How a garment is brought off the body and off the garments below it.

    Each number says what it is for; numbers that follow from others are properties. `benchmarks/sensitivity.py`
    measures the effect of halving and doubling each.
    """

    max_displacement: float = MAX_DISPLACEMENT
    """No vertex moves farther than this, however wrong its distance is [m]. Cloth closer than this at rest to another
    garment is taken to lie on it. The rest may end up beside it, as a sleeve does beside shorts. Folds farther than
    twice this from other garments are left alone: unfolding all raises the mean vertex error by 0.2 mm."""
    max_pushes: int = 4
    """Limit on the pushes of a vertex, the rounds of raising edges, and the partings of garments that cut each other.
    Where closest faces are wrong over a patch, a search also goes this many edges from its rim into it."""
    gap: float = 0.004
    """How far apart two garments are kept, how far cloth stays in front of a limb that comes between it and its skin
    (half way where there is less room), and how far triangles that cut each other go in one sweep [m]. Triangles cut
    the corners between vertices: with half of it 2.6 % of frames of shirt and shorts are cut, against none. An edge
    whose middle is too low by up to this is raised in full, one too low by twice as much not at all: it runs through a
    hand. Were it raised, a T-shirt on limbs that run through the trunk would lie 40 mm elsewhere, not 5, when the
    person turns."""
    near: int = 2
    """How far around a pushed vertex the cloth moves with it [edges]. Farther out nothing collides, and moving cloth
    there makes nothing more accurate; fingers are thinner than a garment's edges are long."""
    around: int = 6
    """How far cloth gives way, less and less, around a push off a garment below, a limb or a fold [edges], and how many
    sweeps smooth it there. Even: sweeps between two buffers then end in the one where they began."""
    levellings: int = 48
    """How many sweeps level cloth that is folded over. Even. In 343 recorded frames of a T-shirt over shorts, 16 sweeps
    leave 2.3 % of frames cut, 32 and 48 leave 0.3 %, and 100 none. With 48 a T-shirt jumps by more than 20 mm in 1.7 %
    of frame pairs (with its network alone in 1.2), with 100 in 2.9 %."""
    limb_reach: float = 0.08
    """Up to this height above its skin cloth lies on it; at twice the height it doesn't, since neighbours there lie on
    different legs, and would tear if pressed to them [m]. Half as far to its side cloth still feels a limb, less and
    less: a swinging hand moves 30 mm in a frame. Felt from 80 mm, a skirt is off by 7.0 mm and jumps by more than 20 mm
    in 8.7 % of 343 recorded frame pairs; from 40 mm by 6.7 mm and in 9.0 %, from 20 mm by 6.6 mm and in 9.3 %. Cloth
    near its skin feels limbs from less far: twice its height squared, divided by this. Cloth whose networks know where
    arms are (`Wearable.knows_arms`) feels limbs only within the length of one of its edges: what the networks predict
    is closer to the truth than where a limb farther off would draw the cloth."""
    strain_limit: float = 1.6
    """How many times its rest length an edge may be, unless it was predicted longer, before its ends are drawn
    together. In 116 recorded frames .0016 % of a skirt's edges are twice as long as at rest, and .026 % with a limit of
    3.2. In 33 % of frames some edge of a T-shirt is beyond the limit, and such a frame costs one push more. With a
    limit of 1.4 it is 48 % of frames, with 1.25 it is 96 %; crossings and jumps stay as many."""
    alike: float = 0.5
    """Cosine from which on two sheets count in full as facing the same way; down to a right angle this fades to
    nothing. A push off a garment below counts by that weight, or by as much where the two face each other. By the same
    weight cloth that faces where skinning turns it is left as it is; the rest has folded over, and is levelled. Of 20
    frames that are all cut without levelling, this leaves 2 cut; levelling only below 0.25 leaves 7."""
    layer_margin: float = 0.5
    """Share of the body's margin that is kept after a garment was brought off those below it a second time. A push off
    the body may push a vertex into a layer, and the other way round; the rest of the margin is slack for both."""
    layer_reach: float = 0.03
    """How far away the sheet below is still felt [m]. This fades in the last quarter, and beyond the sheet's open rims.
    The places on it where a search for the closest one may start are this far apart. Only cloth in a fold is deeper,
    and which side of the fold is closest changes from frame to frame. The body is such a sheet, too: cloth that is
    deeper in it goes back to its own side (`OwnSide`). From 20 mm on, a skirt jumps by more than 20 mm in 12.1 % of 116
    recorded frame pairs, from 30 mm on in 10.3 %, as many as if cloth were left where it is."""

    def __post_init__(self) -> None:
        """Raises `MeshError` for a gap that isn't positive, as rays step by it, and for numbers that aren't even."""
        if not self.gap > 0 or self.around % 2 or self.levellings % 2:
            given = f"{self.gap}, {self.around} and {self.levellings}"
            raise MeshError(f"wanted a gap of more than 0 m, and even numbers for around and levellings, got {given}")

    @property
    def tolerance(self) -> float:
        """How far short of the margin vertices may stay, and how far apart cutting triangles are brought [m].

        Distances at the ends of an edge may differ by this much more than its length before one of them is doubted.
        """
        return self.gap / 20

    @property
    def sweeps(self) -> int:
        """How many sweeps draw torn edges together, and part triangles that cut each other.

        In so many sweeps a movement spreads as far as cloth gives way, and back.
        """
        return 2 * self.around

    @property
    def blend_steps(self) -> tuple[float, float]:
        """How far the two sweeps of a pair go towards the mean of the neighbours: Chebyshev's for two steps.

        They level ripples from the finest that triangles carry, which a whole step inverts at half their height, to
        those as wide as cloth gives way on both sides. The long step levels wide ripples, and the short one the fine
        ripples that the long one overshoots.
        """
        finest, widest = 1.5, (math.pi / (2 * max(self.around, 1))) ** 2
        middle, half = (finest + widest) / 2, (finest - widest) / 2 * math.sqrt(0.5)
        return 1 / (middle - half), 1 / (middle + half)

    @property
    def fade(self) -> float:
        """The factor by which cloth gives way less from one edge to the next."""
        return 1 - 1 / max(self.around, 1)

    @property
    def parting_most(self) -> float:
        """The farthest that garments are parted [m]: cloth that cuts another in one frame alone leaps so far.

        Without a limit T-shirts leap by 53 mm.
        """
        return self.max_pushes * self.gap


DEFAULT_CONTACT = ContactSettings()
