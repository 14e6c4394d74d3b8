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
    """Pushes of a vertex, rounds of raised edges, and how many edges far a search goes from the rim of a patch of wrong
    closest faces into it."""
    tolerance: float = 2e-4
    """What may be missing to the margin, how far apart triangles that cut each other are brought, and by how much more
    than their edge is long distances at its ends may differ before one of them is doubted [m]."""

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
    own_weight: float = 0.02
    """A vertex lies on every limb that has more than this of its skinning weight: at the armpit, on trunk and arm."""
    press_room: float = 0.006
    """How far before a limb cloth stays, on the side of the skin it lies on; half way where there is less room [m].
    Cloth nearer to the skin than this isn't pressed, and cloth from twice as far on in full."""
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
    """Looks along the way from the skin to a vertex, a `press_room` apart at least."""
    press_slope: float = 0.7
    """How fast that fades beyond, per length along the cloth's edges: a dent, not a tear."""

    # Neighbours
    blend_steps: tuple[float, float] = (3.0, 0.75)
    """How far the two sweeps of a pair go towards the mean of the neighbours. The long step levels what is wide, the
    short one the ripples that the long one overdoes (Richardson). A pair leaves at most 0.6 of any ripple."""
    blend_pairs: int = 3
    """Pairs of sweeps. Three do what twelve plain means do."""

    # Edges
    bulge: float = 0.375
    """How far skin is expected to bulge towards the middle of an edge, per length of the edge and per radian between
    the normals below its ends: three times as far as a circle does."""
    through: float = 0.005
    """An edge whose middle lacks up to this is raised in full, and one that lacks twice as much not at all [m]. An edge
    that lacks more runs through a hand, and raising it would throw its ends centimetres away."""

    # Cloth that was torn apart
    strain_limit: float = 1.6
    """How many times their rest length edges may be, unless they were predicted longer, before their ends are drawn
    together. Of 116 recorded frames .0018 % of a T-shirt's edges are twice as long as at rest, without a limit .013 %;
    the pairs of frames in which a vertex of a shirt jumps by more than 20 mm are 1.7 and 4.3 %. With 1.8 both are as
    with 1.6, and a skirt's vertex jumps by 46 mm (38)."""
    strain_sweeps: int = 16
    """How often. Even: what is swept ends where it began."""

    # Cloth that has folded over, of garments worn together. Counts are of frames cut, of 20 that all are without it.
    unfold_cosines: tuple[float, float] = (0.5, 0.0)
    """Cosines between where cloth faces and where skinning turns it: below the first it gives way, at the second in
    full. Leaves 2; 0.25 to -0.25 leave 7."""
    unfold_fade: float = 0.8
    """What is left of that from edge to edge."""
    unfold_rounds: int = 100
    """How often it is levelled. Even. A hundred leave 2, 64 5, 32 6."""

    # Garments over each other
    layer_gap: float = 0.004
    """How far apart two garments are kept, and triangles that cut each other go in one sweep [m]: they cut the corners
    between vertices."""
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
    layer_doubt: float = 0.012
    """A search that ends this far below the sheet may have found another fold, so a tree is asked [m]. If none ever is,
    a T-shirt over shorts jumps in 3.2 % of 343 recorded frame pairs, not in 2.6 %."""
    layer_agreement: float = 0.25
    """Cosine of the garments' normals from which on a push counts in full; at a right angle it doesn't count at all."""

    # Triangles of garments that cut each other, or the body where it has no room for them. The counts of frames are of
    # a version that levelled cloth deep inside the body first, and had no `parting_most`.
    parting_rounds: int = 32
    """How often it is levelled. Of 116 recorded frames 16 leave 6 cut, 32 leave 4."""
    parting_most: float = 0.012
    """How far it moves a vertex at most [m]: so far cloth leaps that cuts in one frame and not in the next. Without a
    limit T-shirts leap by 53 mm. Of 26 recorded frames of shirt and shorts with cuts 8 mm leave 6, 12 mm 3."""
    parting_sweeps: int = 12
    """How often triangles are brought apart, before the body has its word. Eight leave 5 of 116 cut, twelve 3."""
    partings: int = 3
    """How often all of that is done, while any cut. Once leaves 6 of 116 cut, twice 4; four times no fewer."""


DEFAULT_CONTACT = ContactSettings()
