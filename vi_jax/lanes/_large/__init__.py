"""Arrays within a lane that are too large for registers: in memory, or known by a formula.

An array of more than `MOST_IN_REGISTERS` numbers is a `Large`; a smaller one is an object array of
`Value`s. What is done with a large one number by number stays a formula until it is needed, so that
neighbouring operations become one loop and nothing is computed that is not asked for.
"""

from .held import as_large as as_large
from .held import fill as fill
from .held import held as held
from .held import replace as replace
from .held import room as room
from .held import same as same
from .held import selected as selected
from .held import settled as settled
from .held import store_at as store_at
from .held import stored as stored
from .held import table as table
from .index import Index as Index
from .index import contiguous as contiguous
from .index import counted as counted
from .index import in_lanes as in_lanes
from .index import over as over
from .index import place_of as place_of
from .index import plus as plus
from .index import splat as splat
from .index import times as times
from .kinds import MOST_IN_REGISTERS as MOST_IN_REGISTERS
from .kinds import Formula as Formula
from .kinds import Held as Held
from .kinds import Large as Large
from .kinds import Masked as Masked
from .kinds import Memory as Memory
from .kinds import Strided as Strided
from .kinds import Table as Table
from .kinds import Values as Values
from .kinds import at as at
from .kinds import gathered as gathered
from .kinds import joined as joined
from .kinds import kind_in as kind_in
from .kinds import scattered as scattered
from .kinds import uniform as uniform
from .moved import LARGE as LARGE
from .moved import chosen as chosen
from .placed import PLACED as PLACED
from .sums import in_one as in_one
