"""The scalar code that drives a group of lanes forward and back (`_tape.py`), as LLVM's text.

The blocks, of which `docs/internals/lanes.md` has the picture:

    take     a group's lanes, as long as there are any; begin
    forward  as long as a lane goes on: keep the carry (a full tape grows), step
    turn     all have ended: through `end`, then back through the iterations
    finish   through `begin`
"""

# What a kernel stores in `stop` where it gets no memory, or where a tape would outgrow its limit.
OUT_OF_MEMORY = 2

# Memory lies on multiples of 64 bytes, so that no vector is part of two lines of the cache.
DRIVER = """\
declare ptr @malloc(i64)
declare void @free(ptr)
declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)

define internal ptr @aligned(ptr %memory) {{
  %address = ptrtoint ptr %memory to i64
  %over = and i64 %address, 63
  %rest = sub i64 64, %over
  %place = getelementptr i8, ptr %memory, i64 %rest
  ret ptr %place
}}

define void @kernel(ptr %inputs, ptr %strides, ptr %outputs, i64 %lanes, ptr %next, ptr %stop) #0 {{
entry:
  %memory = call ptr @malloc(i64 {frame})
  %first.size = mul i64 {entry}, {entries}
  %first.whole = add i64 %first.size, 64
  %first.tape = call ptr @malloc(i64 %first.whole)
  %none = icmp eq ptr %memory, null
  %none.tape = icmp eq ptr %first.tape, null
  %lacks = or i1 %none, %none.tape
  %frame = call ptr @aligned(ptr %memory)
  br i1 %lacks, label %lack, label %take

take:
  %tape.t = phi ptr [ %first.tape, %entry ], [ %tape, %finish ]
  %room.t = phi i64 [ {entries}, %entry ], [ %room, %finish ]
  %first = atomicrmw add ptr %next, i64 {width} monotonic
  %left = icmp slt i64 %first, %lanes
  br i1 %left, label %begin, label %leave
begin:
  %begun = call i1 @begin({call}, i64 %first, i64 %lanes)
  br i1 %begun, label %forward, label %turn

forward:
  %n = phi i64 [ 0, %begin ], [ %n.next, %put ]
  %tape.f = phi ptr [ %tape.t, %begin ], [ %tape.p, %put ]
  %room.f = phi i64 [ %room.t, %begin ], [ %room.p, %put ]
  %halt.1 = load volatile i8, ptr %stop
  %halted.1 = icmp ne i8 %halt.1, 0
  br i1 %halted.1, label %leave, label %keep
keep:
  %full = icmp eq i64 %n, %room.f
  br i1 %full, label %grow, label %put
grow:
  %old.size = mul i64 %room.f, {entry}
  %room.more = mul i64 %room.f, 2
  %new.size = mul i64 %old.size, 2
  %new.whole = add i64 %new.size, 64
  %beyond = icmp ugt i64 %new.size, {most}
  br i1 %beyond, label %lack, label %ask
ask:
  %new = call ptr @malloc(i64 %new.whole)
  %new.none = icmp eq ptr %new, null
  br i1 %new.none, label %lack, label %move
move:
  %move.to = call ptr @aligned(ptr %new)
  %move.from = call ptr @aligned(ptr %tape.f)
  call void @llvm.memcpy.p0.p0.i64(ptr %move.to, ptr %move.from, i64 %old.size, i1 false)
  call void @free(ptr %tape.f)
  br label %put
put:
  %tape.p = phi ptr [ %tape.f, %keep ], [ %new, %move ]
  %room.p = phi i64 [ %room.f, %keep ], [ %room.more, %move ]
  %entries.p = call ptr @aligned(ptr %tape.p)
  %at.byte = mul i64 %n, {entry}
  %put.to = getelementptr i8, ptr %entries.p, i64 %at.byte
  call void @llvm.memcpy.p0.p0.i64(ptr %put.to, ptr %frame, i64 {entry}, i1 false)
  %more = call i1 @step({call}, i64 %n)
  %n.next = add i64 %n, 1
  br i1 %more, label %forward, label %turn

turn:
  %total = phi i64 [ 0, %begin ], [ %n.next, %put ]
  %tape = phi ptr [ %tape.t, %begin ], [ %tape.p, %put ]
  %room = phi i64 [ %room.t, %begin ], [ %room.p, %put ]
  %entries = call ptr @aligned(ptr %tape)
  call void @end_back({call})
  br label %back
back:
  %b.next = phi i64 [ %total, %turn ], [ %b, %through ]
  %some = icmp sgt i64 %b.next, 0
  br i1 %some, label %look, label %finish
look:
  %halt.2 = load volatile i8, ptr %stop
  %halted.2 = icmp ne i8 %halt.2, 0
  br i1 %halted.2, label %leave, label %through
through:
  %b = sub i64 %b.next, 1
  %b.byte = mul i64 %b, {entry}
  %b.entry = getelementptr i8, ptr %entries, i64 %b.byte
  call void @step_back({call}, ptr %b.entry, i64 %b)
  br label %back

finish:
  call void @begin_back({call})
  br label %take

lack:
  %tape.l = phi ptr [ %first.tape, %entry ], [ %tape.f, %grow ], [ %tape.f, %ask ]
  store volatile i8 {out_of_memory}, ptr %stop
  br label %leave
leave:
  %tape.e = phi ptr [ %tape.t, %take ], [ %tape.f, %forward ], [ %tape, %look ], [ %tape.l, %lack ]
  call void @free(ptr %tape.e)
  call void @free(ptr %memory)
  ret void
}}"""
