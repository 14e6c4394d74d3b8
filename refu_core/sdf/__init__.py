"""Signed distance to the posed body: the protocol, and the exact implementation."""

from refu_core.sdf._exact import ClosestPoints as ClosestPoints
from refu_core.sdf._exact import ExactSdf as ExactSdf
from refu_core.sdf._protocol import BodySdf as BodySdf
from refu_core.sdf._protocol import SdfSample as SdfSample
from refu_core.sdf._topology import check_faces as check_faces
