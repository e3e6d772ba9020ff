/* SPDX-License-Identifier: Apache-2.0
   Frames of one publisher for all its readers on this host: a ring in shared memory, and slots for large bodies behind it
   (WIRE.md, sections 3.3 and 6). For C and C++.

   The publisher is the only one that writes to this memory. Each reader has a page of its own, in which it says how far it
   has read, which slots it looks at, and whether it sleeps; it can harm nobody but itself there. Positions count bytes and
   never wrap.

   `reserved` is raised before bytes are written, `head` after: a reader copies first and then looks whether `reserved` has
   come round to what it has copied. A reliable reader is never overrun unless it is lagging: the publisher waits for its `tail`.

   A slot is written while its word is 0. A reader leases it and then looks at the word, the publisher sets the word to 0 and
   then looks at the leases: one of the two sees the other, and gives way. */

#ifndef CORTEX_BROADCAST_H
#define CORTEX_BROADCAST_H

#include <errno.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#ifdef __SSE2__
#include <emmintrin.h>
#endif

enum {
    CORTEX_MEMBERS = 64,
    CORTEX_MARKS = 16,
    CORTEX_STEPS = 64, /* `reserved` is raised by a part of the ring, of so many */
    CORTEX_HEAD_BYTES = 1 << 16, /* before the frames: a multiple of every page size */
    CORTEX_PAGE_BYTES = 4096,
    CORTEX_ENTRY_BYTES = 8,      /* before each frame: its size, and what it is */
    CORTEX_FRAME_BYTES = 64,     /* of a frame's header, which is all of a frame that names a slot */
    CORTEX_SPARE_BYTES = 128,    /* kept free of messages, so that the last entry always finds room */
    CORTEX_WIDE_BYTES = 1 << 21, /* of a ring that a reliable reader has once been a whole ring behind in */
    CORTEX_SLOTS = 1024,         /* at most: each reader's page has a byte for each */
    CORTEX_SMALL_BYTES = 4 << 20,  /* what small slots take in all, so that they stay in cache; most that growing ones have to spare */
    CORTEX_DEEP_BYTES = 16 << 20,  /* what slots take, and how many there are, where a reader keeps more messages than by default */
    CORTEX_DEEP_SLOTS = 128,
    CORTEX_PRIVATE_BYTES = 64 << 20, /* most that a reader copies of what it may lease no more */
    CORTEX_STREAM_BYTES = 8 << 20, /* of an array that is copied past the caches, which it would sweep out */
};

enum { CORTEX_FRAME = 0, CORTEX_MOVED = 1 };                          /* what an entry is */
enum { CORTEX_SOUND, CORTEX_BROKEN, CORTEX_ENDED };                   /* what a ring is to its reader */
enum { CORTEX_WRITTEN, CORTEX_LAGGING, CORTEX_FULL, CORTEX_TOO_LARGE }; /* what became of a frame */
enum { CORTEX_LEASED, CORTEX_COPY, CORTEX_OVERWRITTEN, CORTEX_NO_SLOT, CORTEX_CROWDED }; /* what a reader finds in a slot */

#define CORTEX_RING_MAGIC 0x3354534143585443u /* "CTXCAST3" */

typedef struct {
    uint64_t magic, capacity, source, generation, slots, slot_bytes;
    uint64_t quota; /* how many slots a reader may lease at once; further messages it copies */
    uint64_t unused;
    uint64_t reserved; /* bytes below this, less the capacity, may have been written over */
    uint64_t unused_two[7];
    uint64_t head; /* all below this is whole; in a cache line that readers look at once for all that has come */
    uint64_t last; /* where the last entry begins */
    uint64_t unused_three[6];
    uint64_t marks[CORTEX_MARKS]; /* where the first entry of each part of the ring begins */
    uint64_t unused_four[472];
    uint64_t words[CORTEX_SLOTS]; /* of each slot: the sequence of its message and 1; 0: it is being written */
} CortexRing;

typedef struct {
    uint64_t tail; /* all below this has been read */
    uint64_t unused[7];
    uint32_t sleeping; /* whoever writes next takes this back and signals the wakeup */
    uint32_t unused_too[15];
    uint64_t generation; /* of the ring to whose slots the leases belong */
    uint64_t unused_three[111];
    uint8_t leases[CORTEX_SLOTS]; /* 1: the reader looks at this slot */
} CortexPage;

/* The memory of one ring: its head, its frames twice in a row, so that no entry is cut, and its slots. */
typedef struct {
    CortexRing *ring;
    uint8_t *data, *slots;
    uint64_t capacity, generation, slot_count, slot_bytes;
    uint32_t users; /* it is unmapped with the last */
} CortexMap;

typedef struct {
    int used, strict, lagging;
    int left; /* it reads no more, but looks at slots still */
    int socket, wakeup;
    CortexPage *page;
    uint64_t tail; /* as last seen */
    uint64_t lagging_until;
    uint32_t timeout_ms; /* longest time that it may hold up one message */
} CortexMember;

/* What the publisher knows of a slot. */
typedef struct {
    uint64_t end;     /* where the entry that names it ends: who has read less may still want it */
    uint64_t written; /* when it was written last: `clock` */
    int busy;         /* it is being written */
} CortexSlot;

typedef struct {
    CortexMap *map;
    CortexRing *ring;
    uint8_t *data;
    uint64_t capacity, source, head, clock;
    int fd;
    int narrow; /* there was no memory for a larger ring: it is not tried again while this one lasts */
    int count; /* of members, those that have left between them included */
    CortexMember members[CORTEX_MEMBERS];
    CortexSlot slots[CORTEX_SLOTS];
} CortexWriter;

/* What a reader shares with the leases of its messages: the publisher frees their slots when the last is gone. */
typedef struct {
    CortexPage *page;
    CortexMap *current;
    int socket, process;
    uint32_t users, lock;
    uint32_t held;          /* leases */
    uint64_t private_bytes; /* of messages that were copied, as there were too many leases */
} CortexSeat;

typedef struct {
    CortexSeat *seat;
    CortexMap *map;
    CortexRing *ring;
    const uint8_t *data;
    CortexPage *page;
    uint64_t capacity, source, tail;
    uint64_t seen;  /* the head when it was looked at last */
    uint64_t first; /* sequence of the first message that is sent to it */
    int socket, wakeup;
    int armed;
    int state; /* CORTEX_BROKEN: it carries something that is no frame; CORTEX_ENDED: more comes through another way only */
} CortexReader;

/* A message in a slot, which stays as it is until `cortex_lease_end`; any thread may call that. */
typedef struct {
    CortexSeat *seat;
    CortexMap *map;
    uint32_t slot;
} CortexLease;

/* The body of a message that came in a slot: leased, or copied where the reader has enough leases. */
typedef struct {
    CortexLease lease; /* of a copy only the seat, where its bytes are counted */
    uint8_t *data;
    uint64_t size;
    int is_leased;
} CortexBody;

typedef struct {
    uint64_t source, reader;
    int socket, page, wakeup;
} CortexHello;

/* Processes: memory, sockets, wakeups. Each returns -1 with errno set if it fails, and where there is no memfd. */

static inline int cortex_writer_open(CortexWriter *writer, uint64_t source, uint64_t capacity);
static inline int cortex_writer_add(CortexWriter *writer, const CortexHello *hello, int strict, uint32_t timeout_ms, uint64_t first); /* owns the hello */
static inline void cortex_writer_remove(CortexWriter *writer, int member); /* its leases hold while its connection does */
static inline void cortex_writer_forget(CortexWriter *writer, int member);
static inline int cortex_writer_grow(CortexWriter *writer, uint64_t capacity, uint64_t slots, uint64_t slot_bytes);
static inline void cortex_writer_close(CortexWriter *writer);
static inline int cortex_listen(const char *path);
static inline int cortex_accept(int listener);
static inline int cortex_hear(int socket, CortexHello *hello); /* EAGAIN: not yet; EPROTONOSUPPORT: it knows rings of another kind */
static inline int cortex_reader_open(CortexReader *reader, const char *path, uint64_t source, uint64_t number);
static inline int cortex_reader_welcomed(CortexReader *reader); /* 1 once the publisher has taken the reader in, else 0; -1: but it cannot be mapped */
static inline int cortex_reader_follow(CortexReader *reader);
static inline void cortex_reader_close(CortexReader *reader); /* leases stay */
static inline void cortex_map_end(CortexMap *map);   /* one user less */
static inline void cortex_seat_end(CortexSeat *seat);
static inline int cortex_process(void);
static inline void cortex_yield(void);
static inline int cortex_is_gone(int socket); /* whether the other end is closed */
static inline void cortex_signal_wakeup(int wakeup);
static inline void cortex_clear_wakeup(int wakeup);

/* As memcpy, but large arrays need not be read into the caches to be written over: a third less traffic. The C library does this,
   too, from a size on that it takes from the processor, which on virtual machines is often ten times too large. */
static inline void cortex_copy(void *to, const void *from, size_t size) {
#ifdef __SSE2__
    if (size >= CORTEX_STREAM_BYTES) {
        uint8_t *out = (uint8_t *)to;
        const uint8_t *in = (const uint8_t *)from;
        size_t at = -(uintptr_t)out & 15; /* stores are aligned */
        memcpy(out, in, at);
        for (; at + 64 <= size; at += 64)
            for (size_t part = at; part < at + 64; part += 16)
                _mm_stream_si128((__m128i *)(void *)(out + part), _mm_loadu_si128((const __m128i *)(const void *)(in + part)));
        memcpy(out + at, in + at, size - at);
        _mm_sfence();
        return;
    }
#endif
    memcpy(to, from, size);
}

static inline uint64_t cortex_entry_bytes(uint64_t size) { return (CORTEX_ENTRY_BYTES + size + 7) & ~(uint64_t)7; }

/* The publisher. Not for several threads at once. */

/* Whether a reliable reader that is not lagging has no room for an entry. */
static inline int cortex_member_is_full(CortexWriter *writer, CortexMember *member, uint64_t bytes) {
    if (!member->used || member->left || !member->strict || member->lagging) return 0;
    if (writer->head + bytes - member->tail <= writer->capacity) return 0;
    member->tail = __atomic_load_n(&member->page->tail, __ATOMIC_ACQUIRE); /* what it has read may be written over */
    if (writer->head + bytes - member->tail <= writer->capacity) return 0;
    member->strict = !cortex_is_gone(member->socket); /* who is dead is not waited for */
    return member->strict;
}

/* Whether somebody gets what comes; `lagging` is set if somebody does not. Who was lagging takes part once
   half of the ring is free, and half of what waited for it then is read. */
static inline int cortex_writer_look(CortexWriter *writer, int *lagging) {
    int some = 0;
    for (int index = 0; index < writer->count; ++index) {
        CortexMember *member = &writer->members[index];
        if (!member->used || member->left) continue;
        if (member->lagging) {
            member->tail = __atomic_load_n(&member->page->tail, __ATOMIC_ACQUIRE);
            member->lagging = writer->head - member->tail > writer->capacity / 2 || member->tail < member->lagging_until;
        }
        *lagging |= member->lagging;
        some |= !member->lagging;
    }
    return some;
}

/* Wait for a reliable reader no more, until it has read half of what waits for it. */
static inline void cortex_member_give_up(const CortexWriter *writer, CortexMember *member) {
    member->lagging = 1;
    member->lagging_until = member->tail + (writer->head - member->tail + 1) / 2;
}

/* Where the frame of the next entry is to be written, for which there is room. If it is not after all, nothing has happened:
   `reserved` stays, as the bytes below it may have changed. It may be raised as far as `ahead` where it has to be raised. */
static inline uint8_t *cortex_ring_begin(CortexRing *ring, uint8_t *data, uint64_t capacity, uint64_t at, size_t size, uint64_t ahead) {
    const uint64_t next = at + cortex_entry_bytes(size);
    if (next > __atomic_load_n(&ring->reserved, __ATOMIC_RELAXED)) {
        __atomic_store_n(&ring->reserved, next > ahead ? next : ahead, __ATOMIC_RELAXED);
        __atomic_thread_fence(__ATOMIC_RELEASE); /* pairs with the fence of `cortex_reader_is_whole` */
    }
    return data + (at & (capacity - 1)) + CORTEX_ENTRY_BYTES;
}

/* Make it readable; where it ends. */
static inline uint64_t cortex_ring_finish(CortexRing *ring, uint8_t *data, uint64_t capacity, uint64_t at, uint32_t what, size_t size) {
    const uint64_t next = at + cortex_entry_bytes(size), part = capacity / CORTEX_MARKS;
    const uint32_t entry[2] = {(uint32_t)size, what};
    memcpy(data + (at & (capacity - 1)), entry, sizeof entry);
    const uint64_t before = __atomic_load_n(&ring->last, __ATOMIC_RELAXED);
    if (before / part != at / part) __atomic_store_n(&ring->marks[at / part % CORTEX_MARKS], at, __ATOMIC_RELAXED);
    __atomic_store_n(&ring->last, at, __ATOMIC_RELAXED);
    __atomic_store_n(&ring->head, next, __ATOMIC_RELEASE);
    return next;
}

/* Say that the ring goes on elsewhere; where that entry ends. */
static inline uint64_t cortex_ring_move(CortexRing *ring, uint8_t *data, uint64_t capacity, uint64_t at) {
    cortex_ring_begin(ring, data, capacity, at, 0, 0);
    return cortex_ring_finish(ring, data, capacity, at, CORTEX_MOVED, 0);
}

static inline uint64_t cortex_writer_readers(const CortexWriter *writer) {
    uint64_t readers = 0;
    for (int index = 0; index < writer->count; ++index) readers += writer->members[index].used && !writer->members[index].left;
    return readers;
}

/* Wake who sleeps: it has set `sleeping` and then looked at `head`, we have set `head` and now look at `sleeping`. */
static inline void cortex_writer_wake(CortexWriter *writer) {
    __atomic_thread_fence(__ATOMIC_SEQ_CST);
    for (int index = 0; index < writer->count; ++index) {
        CortexMember *member = &writer->members[index];
        if (!member->used || member->left || !__atomic_load_n(&member->page->sleeping, __ATOMIC_RELAXED)) continue;
        if (__atomic_exchange_n(&member->page->sleeping, 0, __ATOMIC_ACQ_REL)) cortex_signal_wakeup(member->wakeup);
    }
}

/* Make room for frames of a size in principle: a larger ring, if there is memory for it, where this one could not hold two. */
static inline int cortex_writer_fits(CortexWriter *writer, uint64_t bytes) {
    if (2 * bytes + CORTEX_SPARE_BYTES <= writer->capacity) return 1;
    uint64_t capacity = writer->capacity;
    while (capacity < 4 * bytes) capacity *= 2;
    return cortex_writer_grow(writer, capacity, writer->map->slot_count, writer->map->slot_bytes) == 0 || bytes <= writer->capacity;
}

/* Go on in a larger ring where a reliable reader is a whole one behind; 0 if it stays as it is. The publisher's sleep then is
   a small part of what waits, and the reader finds work all the time: 512 kB of 4 kB messages last for 0.1 ms. */
static inline int cortex_writer_widen(CortexWriter *writer) {
    if (writer->narrow || writer->capacity >= CORTEX_WIDE_BYTES || writer->map->slot_count) return 0;
    writer->narrow = cortex_writer_grow(writer, CORTEX_WIDE_BYTES, 0, 0) < 0;
    return !writer->narrow;
}

/* Let go of who has left and looks at nothing any more, or has ended. */
static inline void cortex_writer_tidy(CortexWriter *writer) {
    for (int index = 0; index < writer->count; ++index) {
        CortexMember *member = &writer->members[index];
        if (member->used && member->left && cortex_is_gone(member->socket)) cortex_writer_forget(writer, index);
    }
}

/* How far `reserved` may be raised for an entry, so that readers seldom find its cache line changed: not over what reliable ones have
   still to read. */
static inline uint64_t cortex_writer_ahead(const CortexWriter *writer, size_t size) {
    uint64_t ahead = writer->head + writer->capacity / CORTEX_STEPS;
    if (writer->head + cortex_entry_bytes(size) <= __atomic_load_n(&writer->ring->reserved, __ATOMIC_RELAXED)) return 0; /* it is */
    for (int index = 0; index < writer->count; ++index) {
        const CortexMember *member = &writer->members[index];
        const uint64_t end = member->tail + writer->capacity;
        if (member->used && !member->left && member->strict && !member->lagging && end < ahead) ahead = end;
    }
    return ahead;
}

/* Where a frame for all readers is to be written, in `place`, before `cortex_writer_finish`: NULL if nobody gets it. If all are
   lagging it is not written: what waits for them stays. With `all_or_none`, a lagging reader counts as full. */
static inline int cortex_writer_begin(CortexWriter *writer, size_t size, int all_or_none, uint8_t **place) {
    const uint64_t bytes = cortex_entry_bytes(size) + CORTEX_SPARE_BYTES;
    int lagging = 0;
    const int some = cortex_writer_look(writer, &lagging);
    *place = NULL;
    if (lagging && all_or_none) return CORTEX_FULL;
    if (!some) return lagging ? CORTEX_LAGGING : CORTEX_WRITTEN;
    if (size > (uint64_t)1 << 31 || !cortex_writer_fits(writer, bytes)) return CORTEX_TOO_LARGE;
    for (int index = 0; index < writer->count; ++index)
        if (cortex_member_is_full(writer, &writer->members[index], bytes) && !cortex_writer_widen(writer)) return CORTEX_FULL;
    *place = cortex_ring_begin(writer->ring, writer->data, writer->capacity, writer->head, size, cortex_writer_ahead(writer, size));
    return lagging ? CORTEX_LAGGING : CORTEX_WRITTEN;
}

static inline void cortex_writer_finish(CortexWriter *writer, size_t size) {
    writer->head = cortex_ring_finish(writer->ring, writer->data, writer->capacity, writer->head, CORTEX_FRAME, size);
    cortex_writer_wake(writer);
}

/* Send a frame to all readers. */
static inline int cortex_writer_put(CortexWriter *writer, const void *frame, size_t size, int all_or_none) {
    uint8_t *place;
    const int found = cortex_writer_begin(writer, size, all_or_none, &place);
    if (place == NULL) return found;
    memcpy(place, frame, size);
    cortex_writer_finish(writer, size);
    return found;
}

/* Send the last frame, for which there is room always; of at most 64 bytes. */
static inline void cortex_writer_end(CortexWriter *writer, const void *frame, size_t size) {
    memcpy(cortex_ring_begin(writer->ring, writer->data, writer->capacity, writer->head, size, 0), frame, size);
    cortex_writer_finish(writer, size);
}

/* Send all readers another way: they find the end of the ring after what is in it, and attach anew. It is to be closed. */
static inline void cortex_writer_dissolve(CortexWriter *writer) {
    writer->head = cortex_ring_move(writer->ring, writer->data, writer->capacity, writer->head);
    cortex_writer_wake(writer);
}

#include "broadcast_slots.h"
#include "broadcast_reader.h"
#include "broadcast_os.h"

#endif
