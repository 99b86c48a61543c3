"""Arrays within a lane: in registers, in memory, or known by a formula.

An array of at most `MOST_IN_REGISTERS` numbers is held in registers. What is done with a larger one
number by number stays a formula until it is needed, so that neighbouring operations become one loop
and nothing is computed that is not asked for.
"""

from .held import addressable as addressable
from .held import fill as fill
from .held import held as held
from .held import mapped as mapped
from .held import over_all as over_all
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
from .kinds import Array as Array
from .kinds import Formula as Formula
from .kinds import Masked as Masked
from .kinds import Memory as Memory
from .kinds import Registers as Registers
from .kinds import Strided as Strided
from .kinds import Table as Table
from .kinds import gathered as gathered
from .kinds import joined as joined
from .kinds import scattered as scattered
from .kinds import uniform as uniform
from .moved import STRUCTURAL as STRUCTURAL
from .moved import chosen as chosen
from .placed import PLACED as PLACED
from .sums import any_in as any_in
from .sums import in_one as in_one
