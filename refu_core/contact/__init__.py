"""The engineering around the paper's layer: a garment brought off the body, and off the garments below it."""

from refu_core.contact._blend import Blend as Blend
from refu_core.contact._layers import Layer as Layer
from refu_core.contact._own_side import OwnSide as OwnSide
from refu_core.contact._parting import Parting as Parting
from refu_core.contact._press import LimbMeshes as LimbMeshes
from refu_core.contact._press import Press as Press
from refu_core.contact._resolver import ASKED_FROM as ASKED_FROM
from refu_core.contact._resolver import Resolution as Resolution
from refu_core.contact._resolver import Resolver as Resolver
from refu_core.contact._settings import DEFAULT_CONTACT as DEFAULT_CONTACT
from refu_core.contact._settings import ContactSettings as ContactSettings
from refu_core.contact._sheet import Sheet as Sheet
from refu_core.contact._strain import StrainLimit as StrainLimit
from refu_core.contact._unfold import Unfold as Unfold
from refu_core.contact._way_out import WayOut as WayOut
