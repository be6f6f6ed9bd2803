/* The loops of a launch in reverse mode: a thread runs a block of lanes to its end, logs its steps, and then transposes
   them, the last one first. A lane's numbers depend neither on the thread nor on the other lanes of its block. */
#pragma once
#include <sys/mman.h>
#include "launch.h"

/* Rows of the log: the system provides the memory of a row when it is first written. */
enum : i64 { ROOM = LOG_BYTES/sizeof(Row) };

/* Log the steps of a block until every lane has ended. Return the number of rows, or -1 if there is no room for them. */
static i64 log_steps(ahead::Block& a, const ahead::Shared& s, mask* on, Row* rows) {
  i64 count = 0;
  for (bool active = true; active;) {
    for (int k = 0; k < ROUNDS; k++) {
      ahead::renew(a, s);
      for (int i = 0; i < STEPS; i++) {
        if (count == ROOM) return -1;
        Row& row = rows[count];
        note_start(a, row);
        ahead::step(a, s);
        note_end(a, row);
        bool some = false;
        for (int q = 0; q < VECTORS; q++) some |= any(row.on[q] = row.on[q] & on[q]);
        count += some;
      }
    }
    mask more[VECTORS];
    ahead::running(a, s, more);
    active = false;
    for (int q = 0; q < VECTORS; q++) active |= any(on[q] = on[q] & more[q]);
  }
  return count;
}

static void* work(void* given) {
  Job* job = (Job*)given;
  const Array *lanes = job->arrays + UNIFORM, *carry = lanes + OF_LANES;
  ahead::Shared s;
  back::Shared t;
  ahead::prepare(s, job->arrays);
  back::prepare(t, job->arrays);
  ahead::Block a;
  back::Block b;
  memset((void*)&a, 0, sizeof a);
  memset((void*)&b, 0, sizeof b);
  Row* rows = (Row*)mmap(0, ROOM*sizeof(Row), PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
  for (i64 j; (j = taken(job, SLOTS)) < job->count;) {
    mask on[VECTORS];
    /* A place without a lane computes with a copy of the last one, and logs nothing. */
    for (int p = 0; p < SLOTS; p++) {
      const i64 lane = j + p < job->count ? j + p : job->count - 1;
      ahead::put(a, p, lane, lanes, carry);
      back::put(b, p, lane, lanes, carry);
      set(on[p/LANES], p%LANES, j + p < job->count);
    }
    for (int q = 0; q < VECTORS; q++) { ahead::begin(a, s, q); back::begin(b, t, q); }
    i64 count = rows == MAP_FAILED ? -1 : log_steps(a, s, on, rows);
    const bool whole = count >= 0;
    while (count > 0) {
      recall(b, rows[--count]);
      back::step(b, t);
    }
    for (int p = 0; p < SLOTS && j + p < job->count; p++) {
      back::take(b, p, j + p, carry);
      /* Without a whole log the results are no numbers: a NaN has all bits set. */
      for (int i = 0; i < RESULTS && !whole; i++)
        memset((char*)job->arrays[FIRST + i].data + (j + p)*WIDTHS[i], 0xff, WIDTHS[i]);
    }
  }
  if (rows != MAP_FAILED) munmap(rows, ROOM*sizeof(Row));
  return 0;
}
