/* SPDX-License-Identifier: Apache-2.0
   Frames of one publisher for all its readers on this host: a ring in shared memory (WIRE.md, section 3.3). For C and C++.

   The publisher is the only one that writes to the ring. Each reader has a page of its own, in which it says how far it
   has read, and whether it sleeps; it can harm nobody but itself there. Positions count bytes and never wrap.

   `reserved` is raised before bytes are written, `head` after: a reader copies first and then looks whether `reserved` has
   come round to what it has copied. A reliable reader is never overrun unless it is late: the publisher waits for its `tail`. */

#ifndef CORTEX_BROADCAST_H
#define CORTEX_BROADCAST_H

#include <errno.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

enum {
    CORTEX_MEMBERS = 64,
    CORTEX_MARKS = 16,
    CORTEX_HEAD_BYTES = 1 << 16, /* before the frames: a multiple of every page size */
    CORTEX_PAGE_BYTES = 4096,
    CORTEX_ENTRY_BYTES = 8,      /* before each frame: its size, and what it is */
    CORTEX_SPARE_BYTES = 128,    /* kept free of messages, so that the last entry always finds room */
};

enum { CORTEX_FRAME = 0, CORTEX_MOVED = 1 };                          /* what an entry is */
enum { CORTEX_WRITTEN, CORTEX_LATE, CORTEX_FULL, CORTEX_TOO_LARGE }; /* what became of a frame */

#define CORTEX_RING_MAGIC 0x3154534143585443u /* "CTXCAST1" */

typedef struct {
    uint64_t magic, capacity, source, unused[5];
    uint64_t reserved; /* bytes below this, less the capacity, may have been written over */
    uint64_t head;     /* all below this is whole */
    uint64_t last;     /* where the last entry begins */
    uint64_t unused_too[5];
    uint64_t marks[CORTEX_MARKS]; /* where the first entry of each part of the ring begins */
} CortexRing;

typedef struct {
    uint64_t tail; /* all below this has been read */
    uint64_t unused[7];
    uint32_t sleeping; /* whoever writes next takes this back and rings the bell */
    uint32_t unused_too[15];
} CortexPage;

typedef struct {
    int used, strict, late;
    int socket, bell;
    CortexPage *page;
    uint64_t tail; /* as last seen */
} CortexMember;

typedef struct {
    CortexRing *ring;
    uint8_t *data; /* mapped twice in a row, so that no entry is cut */
    uint64_t capacity, source, head;
    int fd;
    int count; /* of members, those that have left between them included */
    CortexMember members[CORTEX_MEMBERS];
} CortexWriter;

typedef struct {
    CortexRing *ring;
    const uint8_t *data;
    CortexPage *page;
    uint64_t capacity, source, tail;
    uint64_t first; /* sequence of the first message that is sent to it */
    int socket, bell;
    int armed, broken;
} CortexReader;

typedef struct {
    uint64_t source, reader;
    int socket, page, bell;
} CortexHello;

/* Processes: memory, sockets, bells. Each returns -1 with errno set if it fails, and where there is no memfd. */

static inline int cortex_writer_open(CortexWriter *writer, uint64_t source, uint64_t capacity);
static inline int cortex_writer_add(CortexWriter *writer, const CortexHello *hello, int strict, uint64_t first); /* owns the hello */
static inline void cortex_writer_remove(CortexWriter *writer, int member);
static inline int cortex_writer_grow(CortexWriter *writer, uint64_t capacity);
static inline void cortex_writer_close(CortexWriter *writer);
static inline int cortex_listen(const char *path);
static inline int cortex_accept(int listener);
static inline int cortex_hear(int socket, CortexHello *hello); /* EAGAIN: not yet */
static inline int cortex_reader_open(CortexReader *reader, const char *path, uint64_t source, uint64_t number);
static inline int cortex_reader_welcomed(CortexReader *reader); /* 1 once the publisher has taken the reader in, else 0 */
static inline int cortex_reader_follow(CortexReader *reader);
static inline void cortex_reader_close(CortexReader *reader);
static inline int cortex_is_gone(int socket); /* whether the other end is closed */
static inline void cortex_ring_bell(int bell);
static inline void cortex_hush_bell(int bell);

static inline uint64_t cortex_entry_bytes(uint64_t size) { return (CORTEX_ENTRY_BYTES + size + 7) & ~(uint64_t)7; }

/* The publisher. Not for several threads at once. */

/* Whether a reliable reader that is not late has no room for an entry. */
static inline int cortex_member_is_full(CortexWriter *writer, CortexMember *member, uint64_t bytes) {
    if (!member->used || !member->strict || member->late) return 0;
    if (writer->head + bytes - member->tail <= writer->capacity) return 0;
    member->tail = __atomic_load_n(&member->page->tail, __ATOMIC_ACQUIRE); /* what it has read may be written over */
    if (writer->head + bytes - member->tail <= writer->capacity) return 0;
    member->strict = !cortex_is_gone(member->socket); /* who is dead is not waited for */
    return member->strict;
}

/* Whether somebody gets what comes; `late` is set if somebody does not. Who was late takes part once half is free. */
static inline int cortex_writer_look(CortexWriter *writer, int *late) {
    int some = 0;
    for (int index = 0; index < writer->count; ++index) {
        CortexMember *member = &writer->members[index];
        if (!member->used) continue;
        if (member->late) {
            member->tail = __atomic_load_n(&member->page->tail, __ATOMIC_ACQUIRE);
            member->late = writer->head - member->tail > writer->capacity / 2;
        }
        *late |= member->late;
        some |= !member->late;
    }
    return some;
}

/* Write an entry for which there is room. */
static inline void cortex_writer_append(CortexWriter *writer, uint32_t what, const void *frame, size_t size) {
    CortexRing *ring = writer->ring;
    const uint64_t at = writer->head, next = at + cortex_entry_bytes(size), part = writer->capacity / CORTEX_MARKS;
    const uint32_t entry[2] = {(uint32_t)size, what};
    __atomic_store_n(&ring->reserved, next, __ATOMIC_RELAXED);
    __atomic_thread_fence(__ATOMIC_RELEASE); /* pairs with the fence of `cortex_reader_is_whole` */
    uint8_t *place = writer->data + (at & (writer->capacity - 1));
    memcpy(place, entry, sizeof entry);
    if (size) memcpy(place + CORTEX_ENTRY_BYTES, frame, size);
    const uint64_t before = __atomic_load_n(&ring->last, __ATOMIC_RELAXED);
    if (before / part != at / part) __atomic_store_n(&ring->marks[at / part % CORTEX_MARKS], at, __ATOMIC_RELAXED);
    __atomic_store_n(&ring->last, at, __ATOMIC_RELAXED);
    __atomic_store_n(&ring->head, next, __ATOMIC_RELEASE);
    writer->head = next;
}

/* Wake who sleeps: it has set `sleeping` and then looked at `head`, we have set `head` and now look at `sleeping`. */
static inline void cortex_writer_wake(CortexWriter *writer) {
    __atomic_thread_fence(__ATOMIC_SEQ_CST);
    for (int index = 0; index < writer->count; ++index) {
        CortexMember *member = &writer->members[index];
        if (!member->used || !__atomic_load_n(&member->page->sleeping, __ATOMIC_RELAXED)) continue;
        if (__atomic_exchange_n(&member->page->sleeping, 0, __ATOMIC_ACQ_REL)) cortex_ring_bell(member->bell);
    }
}

/* Make room for frames of a size in principle: a larger ring, if there is memory for it, where this one could not hold two. */
static inline int cortex_writer_fits(CortexWriter *writer, uint64_t bytes) {
    if (2 * bytes + CORTEX_SPARE_BYTES <= writer->capacity) return 1;
    uint64_t capacity = writer->capacity;
    while (capacity < 4 * bytes) capacity *= 2;
    return cortex_writer_grow(writer, capacity) == 0 || bytes <= writer->capacity;
}

/* Send a frame to all readers. If all are late it is not written: what waits for them stays. With `mind`, somebody who is
   late counts as having no room. */
static inline int cortex_writer_put(CortexWriter *writer, const void *frame, size_t size, int mind) {
    const uint64_t bytes = cortex_entry_bytes(size) + CORTEX_SPARE_BYTES;
    if (size > (uint64_t)1 << 31 || !cortex_writer_fits(writer, bytes)) return CORTEX_TOO_LARGE;
    int late = 0;
    const int some = cortex_writer_look(writer, &late);
    if (late && mind) return CORTEX_FULL;
    if (!some) return late ? CORTEX_LATE : CORTEX_WRITTEN;
    for (int index = 0; index < writer->count; ++index)
        if (cortex_member_is_full(writer, &writer->members[index], bytes)) return CORTEX_FULL;
    cortex_writer_append(writer, CORTEX_FRAME, frame, size);
    cortex_writer_wake(writer);
    return late ? CORTEX_LATE : CORTEX_WRITTEN;
}

/* Send the last frame, for which there is room always; of at most 64 bytes. */
static inline void cortex_writer_end(CortexWriter *writer, const void *frame, size_t size) {
    cortex_writer_append(writer, CORTEX_FRAME, frame, size);
    cortex_writer_wake(writer);
}

/* A reader. Not for several threads at once. */

/* Whether what was copied from the tail on has not been written over meanwhile. */
static inline int cortex_reader_is_whole(const CortexReader *reader) {
    __atomic_thread_fence(__ATOMIC_ACQUIRE);
    return __atomic_load_n(&reader->ring->reserved, __ATOMIC_RELAXED) - reader->tail <= reader->capacity;
}

static inline void cortex_reader_move(CortexReader *reader, uint64_t tail) {
    reader->tail = tail;
    __atomic_store_n(&reader->page->tail, tail, __ATOMIC_RELEASE);
}

/* Go on with the oldest entry that will not be written over in a moment. */
static inline void cortex_reader_skip(CortexReader *reader) {
    const CortexRing *ring = reader->ring;
    const uint64_t head = __atomic_load_n(&ring->head, __ATOMIC_ACQUIRE);
    const uint64_t oldest = __atomic_load_n(&ring->reserved, __ATOMIC_RELAXED) - reader->capacity;
    uint64_t best = __atomic_load_n(&ring->last, __ATOMIC_RELAXED);
    for (int index = 0; index < CORTEX_MARKS; ++index) {
        const uint64_t mark = __atomic_load_n(&ring->marks[index], __ATOMIC_RELAXED);
        if (mark >= oldest + reader->capacity / 4 && mark < best) best = mark;
    }
    cortex_reader_move(reader, best <= reader->tail || best > head ? head : best);
}

/* The next frame where it lies, to be copied before `cortex_reader_take`; 0 if there is none, -1 if it is broken. */
static inline int64_t cortex_reader_peek(CortexReader *reader, const uint8_t **frame) {
    while (!reader->broken) {
        const uint64_t head = __atomic_load_n(&reader->ring->head, __ATOMIC_ACQUIRE), left = head - reader->tail;
        uint32_t entry[2];
        if (!left) return 0;
        const uint8_t *place = reader->data + (reader->tail & (reader->capacity - 1));
        if (left <= reader->capacity) memcpy(entry, place, sizeof entry);
        if (left > reader->capacity || !cortex_reader_is_whole(reader)) {
            cortex_reader_skip(reader);
        } else if (entry[1] == CORTEX_MOVED) {
            reader->broken = cortex_reader_follow(reader) < 0;
        } else if (entry[1] != CORTEX_FRAME || !entry[0] || cortex_entry_bytes(entry[0]) > left) {
            reader->broken = 1;
        } else {
            *frame = place + CORTEX_ENTRY_BYTES;
            return entry[0];
        }
    }
    return -1;
}

/* Done with a frame of so many bytes; 0 if it was written over meanwhile, and what was copied is worth nothing. */
static inline int cortex_reader_take(CortexReader *reader, int64_t size) {
    if (!cortex_reader_is_whole(reader)) return 0;
    cortex_reader_move(reader, reader->tail + cortex_entry_bytes((uint64_t)size));
    return 1;
}

/* Have the bell rung when a frame comes; 0 if one is there. To be called when none was. Who took `sleeping` back may ring
   later than we look: whoever finds nothing twice silences what was left of that. */
static inline int cortex_reader_arm(CortexReader *reader) {
    if (reader->armed) cortex_hush_bell(reader->bell);
    reader->armed = 1;
    if (!__atomic_load_n(&reader->page->sleeping, __ATOMIC_RELAXED)) {
        __atomic_store_n(&reader->page->sleeping, 1, __ATOMIC_RELAXED);
        __atomic_thread_fence(__ATOMIC_SEQ_CST); /* see `cortex_writer_wake` */
    }
    return __atomic_load_n(&reader->ring->head, __ATOMIC_ACQUIRE) == reader->tail;
}

/* Have it rung no more; if it was rung, it is silent again. */
static inline void cortex_reader_disarm(CortexReader *reader) {
    if (!reader->armed) return;
    reader->armed = 0;
    if (!__atomic_exchange_n(&reader->page->sleeping, 0, __ATOMIC_ACQ_REL)) cortex_hush_bell(reader->bell);
}

#include "broadcast_os.h"

#endif
