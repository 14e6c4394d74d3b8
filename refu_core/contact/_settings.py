"""Every tuned number of collision handling: its unit and what it is for, in one place."""

from __future__ import annotations

from dataclasses import dataclass

from refu_core.refu import MAX_DISPLACEMENT


@dataclass(frozen=True, kw_only=True)
class ContactSettings:
    """How a garment is brought off the body and off the garments below it.

    Each number says what it is for. `benchmarks/sensitivity.py` measures what half and twice of it do.
    """

    # Pushes along the gradient
    max_displacement: float = MAX_DISPLACEMENT
    """No vertex moves farther than this, however wrong its distance is [m]."""
    max_pushes: int = 4
    """Pushes of a vertex, rounds of raised edges, partings of garments that cut each other, and how many edges far a
    search goes from the rim of a patch of wrong closest faces into it. Of 116 recorded frames one parting leaves 6 cut,
    two leave 4, and more no fewer."""
    tolerance: float = 2e-4
    """What may be missing to the margin, how far apart triangles that cut each other are brought, and by how much more
    than their edge is long distances at its ends may differ before one of them is doubted [m]."""
    gap: float = 0.004
    """How far apart two garments are kept, how far before a limb that comes between it and its skin cloth stays (half
    way where there is less room), and how far triangles that cut each other go in one sweep [m]: they cut the corners
    between vertices. With half of it 6.8 % of frames of shirt and shorts are cut (1.4). An edge whose middle lacks up
    to this is raised in full, and one that lacks twice as much not at all: it runs through a hand. Were it raised, a
    T-shirt on limbs that run through the trunk would lie 40 mm elsewhere, not 5, when the person turns."""
    sweeps: int = 12
    """How often edges that were torn apart, and triangles that cut each other, are drawn to where they should be. Even:
    what is swept ends where it began. Of triangles eight sweeps leave 5 of 116 frames cut, twelve 3."""
    levellings: int = 100
    """How often cloth that is folded over, or cut, is levelled. Even. Of 20 frames with folds a hundred leave 2 cut, 64
    leave 5, 32 leave 6."""

    # Cloth around what is moved
    near: int = 2
    """How far around a pushed vertex cloth goes along [edges]. Farther out nothing collides, and moving it makes
    nothing truer; fingers are thinner than a garment's edges are long. Even."""
    around: int = 6
    """How far around a push off a garment below, a limb or a fold cloth gives way, less and less [edges]. Even: what is
    swept ends where it began. Of shorts' and T-shirts' folds six leave 5 frames cut (with 64 rounds), four 6."""

    # Cloth behind the legs
    tent_share: float = 0.75
    """What share of its way out from before a shin cloth goes: folds keep their order, and the gradient leads backwards
    from where it ends. With half the way the skirt jumps by more than 40 mm in 2.0 % of recorded frame pairs (0.8), and
    with all of it a fifth more of its triangles cut each other. On recorded motion the present skirt hardly needs it;
    of 160 poses with raised heels, without it 9 % aren't free of collisions and 4 % jump by more than 40 mm (none)."""

    # Other limbs beside loose cloth
    press_beside: float = 0.07
    """How far beside a limb cloth still feels it, less and less [m]: a hand that swings goes 30 mm in a frame. With
    50 mm the skirt jumps in 13.1 % of frame pairs, with 70 mm in 12.0 % (before `press_lies`). Cloth whose networks
    know where arms are (`Wearable.knows_arms`) feels limbs as far as one of its edges is long: what those predict is
    nearer to the truth than where a limb from afar draws it."""
    press_flat: float = 0.025
    """Cloth at a height feels limbs beside it as far as the height squared is of this [m]: at 40 mm all that far."""
    press_lies: tuple[float, float] = (0.06, 0.16)
    """Cloth up to the first height [m] lies on its skin, and cloth from the second on doesn't: there neighbours lie on
    different legs, and pressed to them they tear. Of the skirt's edges .028 % are twice as long as at rest, where all
    is pressed .065 %."""
    press_looks: int = 6
    """Looks along the way from the skin to a vertex, a `gap` apart at least."""

    # Neighbours
    blend_steps: tuple[float, float] = (3.0, 0.75)
    """How far the two sweeps of a pair go towards the mean of the neighbours. The long step levels what is wide, the
    short one the ripples that the long one overdoes (Richardson). A pair leaves at most 0.6 of any ripple."""
    blend_pairs: int = 3
    """Pairs of sweeps. Three do what twelve plain means do."""

    # Cloth that was torn apart
    strain_limit: float = 1.6
    """How many times their rest length edges may be, unless they were predicted longer, before their ends are drawn
    together. Of 116 recorded frames .0018 % of a T-shirt's edges are twice as long as at rest, without a limit .013 %;
    the pairs of frames in which a vertex of a shirt jumps by more than 20 mm are 1.7 and 4.3 %. With 1.8 both are as
    with 1.6, and a skirt's vertex jumps by 46 mm (38)."""

    # Cloth that has folded over, of garments worn together. Counts are of frames cut, of 20 that all are without it.
    unfold_cosines: tuple[float, float] = (0.5, 0.0)
    """Cosines between where cloth faces and where skinning turns it: below the first it gives way, at the second in
    full. Leaves 2; 0.25 to -0.25 leave 7."""
    unfold_fade: float = 0.8
    """What is left of that from edge to edge."""

    # Garments over each other
    layer_margin: float = 0.5
    """Share of the body's margin that is left once a garment was brought off those below it again: what pushes a vertex
    off the body may push it into a layer, and the other way round. Both have this much to give."""
    layer_reach: float = 0.03
    """How far the sheet below is felt [m], less and less in the last quarter, and beyond its open rims; as far apart
    are the places on it from which the closest one is looked for. Only cloth in a fold is deeper, and which side
    of the fold is closest changes from frame to frame."""
    layer_meets: float = 0.1
    """Cloth up to this far from the other garment at rest lies on it, and slides by less [m]. The rest may come beside
    it, as a sleeve does beside shorts: a tree is asked for what of that is near. Folds farther than twice this are left
    alone, since they are no fault in themselves: unfolded everywhere, vertices' mean error grows by 0.2 mm."""
    layer_agreement: float = 0.25
    """Cosine of the garments' normals from which on a push counts in full; at a right angle it doesn't count at all.
    If it counted as much as the cosine, 4 of 113 recorded frames of shirt and shorts were cut, not 3."""

    # Triangles of garments that cut each other, or the body where it has no room for them
    parting_most: float = 0.012
    """How far it moves a vertex at most [m]: so far cloth leaps that cuts in one frame and not in the next. Without a
    limit T-shirts leap by 53 mm. Of 26 recorded frames of shirt and shorts with cuts 8 mm leave 6, 12 mm 3."""


DEFAULT_CONTACT = ContactSettings()
