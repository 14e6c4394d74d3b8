"""Signed distance to the posed body: the protocol, the exact and the approximate implementation."""

from refu_core.sdf._approx import ApproxSdf as ApproxSdf
from refu_core.sdf._exact import ClosestPoints as ClosestPoints
from refu_core.sdf._exact import ExactSdf as ExactSdf
from refu_core.sdf._protocol import BodySdf as BodySdf
from refu_core.sdf._protocol import SdfSample as SdfSample
from refu_core.sdf._protocol import query_batch as query_batch
from refu_core.sdf._rest import RestFaces as RestFaces
from refu_core.sdf._topology import check_faces as check_faces
