"""The scalar code that drives a group of lanes forward and back (`_tape.py`), as LLVM's text.

The blocks, of which `docs/internals/lanes.md` has the picture:

    take     a group's lanes, as long as there are any; begin
    forward  as long as a lane goes on: keep the carry if its turn is `due` (thin a full tape), step
    turn     all have ended: through `end`; a window, if not all iterations were kept
    part     from the end, what lies between two entries (`again`, into the window), or all: back
    finish   through `begin`
"""

# What a kernel stores in `stop` where it gets no memory.
OUT_OF_MEMORY = 2

# `shift`: of how many iterations one is kept, as a power of two. Memory lies on multiples of 64
# bytes, so that no vector is part of two lines of the cache.
DRIVER = """\
declare ptr @malloc(i64)
declare void @free(ptr)
declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)

define void @kernel(ptr %inputs, ptr %strides, ptr %outputs, i64 %lanes, ptr %next, ptr %stop) #0 {{
entry:
  %memory = call ptr @malloc(i64 {whole})
  %none = icmp eq ptr %memory, null
  br i1 %none, label %lack, label %divide
divide:
  %address = ptrtoint ptr %memory to i64
  %over = and i64 %address, 63
  %rest = sub i64 64, %over
  %frame = getelementptr i8, ptr %memory, i64 %rest
  %tape = getelementptr i8, ptr %frame, i64 {frame}
  br label %take

take:
  %first = atomicrmw add ptr %next, i64 {width} monotonic
  %left = icmp slt i64 %first, %lanes
  br i1 %left, label %begin, label %leave
begin:
  %begun = call i1 @begin({call}, i64 %first, i64 %lanes)
  br i1 %begun, label %forward, label %turn

forward:
  %n = phi i64 [ 0, %begin ], [ %n.next, %step ]
  %shift = phi i64 [ 0, %begin ], [ %shift.now, %step ]
  %halt.1 = load volatile i8, ptr %stop
  %halted.1 = icmp ne i8 %halt.1, 0
  br i1 %halted.1, label %leave, label %keep
keep:
  %spacing = shl i64 1, %shift
  %between = sub i64 %spacing, 1
  %off = and i64 %n, %between
  %due = icmp eq i64 %off, 0
  br i1 %due, label %room, label %step
room:
  %place = lshr i64 %n, %shift
  %full = icmp eq i64 %place, {entries}
  br i1 %full, label %thin, label %put
thin:
  %i = phi i64 [ 1, %room ], [ %i.next, %thin ]
  %to = mul i64 %i, {entry}
  %from = mul i64 %to, 2
  %thin.to = getelementptr i8, ptr %tape, i64 %to
  %thin.from = getelementptr i8, ptr %tape, i64 %from
  call void @llvm.memcpy.p0.p0.i64(ptr %thin.to, ptr %thin.from, i64 {entry}, i1 false)
  %i.next = add i64 %i, 1
  %i.more = icmp slt i64 %i.next, {half}
  br i1 %i.more, label %thin, label %thinned
thinned:
  %shift.more = add i64 %shift, 1
  br label %put
put:
  %at = phi i64 [ %place, %room ], [ {half}, %thinned ]
  %shift.put = phi i64 [ %shift, %room ], [ %shift.more, %thinned ]
  %at.byte = mul i64 %at, {entry}
  %put.to = getelementptr i8, ptr %tape, i64 %at.byte
  call void @llvm.memcpy.p0.p0.i64(ptr %put.to, ptr %frame, i64 {entry}, i1 false)
  br label %step
step:
  %shift.now = phi i64 [ %shift, %keep ], [ %shift.put, %put ]
  %more = call i1 @step({call}, i64 %n)
  %n.next = add i64 %n, 1
  br i1 %more, label %forward, label %turn

turn:
  %total = phi i64 [ 0, %begin ], [ %n.next, %step ]
  %log = phi i64 [ 0, %begin ], [ %shift.now, %step ]
  call void @end_back({call})
  %every = shl i64 1, %log
  %whole = icmp eq i64 %log, 0
  br i1 %whole, label %part, label %window
window:
  %window.size = mul i64 %every, {entry}
  %made = call ptr @malloc(i64 %window.size)
  %window.none = icmp eq ptr %made, null
  br i1 %window.none, label %lack, label %part

part:
  %entries = phi ptr [ %tape, %turn ], [ %made, %window ], [ %entries, %back ]
  %until = phi i64 [ %total, %turn ], [ %total, %window ], [ %since, %back ]
  %parts.left = icmp sgt i64 %until, 0
  br i1 %parts.left, label %choose, label %finish
choose:
  %last = sub i64 %until, 1
  %kept = lshr i64 %last, %log
  %kept.first = shl i64 %kept, %log
  %since = select i1 %whole, i64 0, i64 %kept.first
  br i1 %whole, label %back.begin, label %again.begin
again.begin:
  ; The frame's own rows are those of the way back, and are put back afterwards.
  %rows = getelementptr i8, ptr %frame, i64 {rows}
  %rows.kept = load <{width} x i64>, ptr %rows, align 8
  %kept.byte = mul i64 %kept, {entry}
  %again.from = getelementptr i8, ptr %tape, i64 %kept.byte
  call void @llvm.memcpy.p0.p0.i64(ptr %frame, ptr %again.from, i64 {entry}, i1 false)
  br label %again
again:
  %a = phi i64 [ %since, %again.begin ], [ %a.next, %again.step ]
  %a.place = sub i64 %a, %since
  %a.byte = mul i64 %a.place, {entry}
  %again.to = getelementptr i8, ptr %entries, i64 %a.byte
  call void @llvm.memcpy.p0.p0.i64(ptr %again.to, ptr %frame, i64 {entry}, i1 false)
  %a.next = add i64 %a, 1
  %a.more = icmp slt i64 %a.next, %until
  br i1 %a.more, label %again.step, label %again.end
again.step:
  %a.left = call i1 @step({call}, i64 %a)
  br label %again
again.end:
  store <{width} x i64> %rows.kept, ptr %rows, align 8
  br label %back.begin
back.begin:
  br label %back
back:
  %b.next = phi i64 [ %until, %back.begin ], [ %b, %back.more ]
  %b = sub i64 %b.next, 1
  %b.place = sub i64 %b, %since
  %b.byte = mul i64 %b.place, {entry}
  %b.entry = getelementptr i8, ptr %entries, i64 %b.byte
  call void @step_back({call}, ptr %b.entry, i64 %b)
  %b.more = icmp sgt i64 %b, %since
  br i1 %b.more, label %back.more, label %part
back.more:
  %halt.2 = load volatile i8, ptr %stop
  %halted.2 = icmp ne i8 %halt.2, 0
  br i1 %halted.2, label %stopped, label %back

finish:
  call void @begin_back({call})
  br i1 %whole, label %take, label %finished
finished:
  call void @free(ptr %entries)
  br label %take

stopped:
  br i1 %whole, label %leave, label %stopped.window
stopped.window:
  call void @free(ptr %entries)
  br label %leave
lack:
  store volatile i8 2, ptr %stop
  br label %leave
leave:
  call void @free(ptr %memory)
  ret void
}}"""
