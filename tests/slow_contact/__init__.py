"""What `refu_core.contact` computes, slowly and plainly: one algorithm, so one reference to hold it against."""

from slow_contact._mend import mend as mend
from slow_contact._resolve import resolve as resolve
