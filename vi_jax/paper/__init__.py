"""The paper's Figures 2, 3 and 4 again: drawn, measured, and compared with what it says."""

from .claims import Claim as Claim
from .claims import check_claims as check_claims
from .faults import Fault as Fault
from .faults import check_faults as check_faults
from .figures import draw_figure as draw_figure
from .motions import Case as Case
from .motions import simulate_cases as simulate_cases
from .report import reproduce as reproduce
