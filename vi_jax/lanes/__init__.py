"""One lane's loop, run for any number of lanes: vector code by LLVM on a CPU, else XLA."""

from ._interrupts import raise_dropped as raise_dropped
from ._interrupts import raise_interrupts_within as raise_interrupts_within
from ._primitive import vector_only as vector_only
from ._program import called as called
from ._program import dependent_results as dependent_results
from ._program import propagate_marks as propagate_marks
from ._vector import Unsupported as Unsupported
from .call import interruptible as interruptible
from .elementary import elementwise_primitive as elementwise_primitive
from .elementary import horner as horner
from .elementary import pin as pin
from .elementary import pin_flag as pin_flag
from .elementary import sincos as sincos
from .elementary import weighted_sum as weighted_sum
from .loop import Emitted as Emitted
from .loop import backend as backend
from .loop import current_backend as current_backend
from .loop import once as once
from .loop import once_with as once_with
from .loop import run as run
from .numpy_call import call_numpy as call_numpy
from .runtime import cores as cores
from .runtime import processor as processor
from .runtime import threads as threads
