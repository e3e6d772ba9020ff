/* SPDX-License-Identifier: Apache-2.0
   The reader of a ring; a part of `broadcast.h`. Not for several threads at once. */

#ifndef CORTEX_BROADCAST_READER_H
#define CORTEX_BROADCAST_READER_H

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
    const uint64_t head = reader->seen = __atomic_load_n(&ring->head, __ATOMIC_ACQUIRE);
    const uint64_t oldest = __atomic_load_n(&ring->reserved, __ATOMIC_RELAXED) - reader->capacity;
    uint64_t best = __atomic_load_n(&ring->last, __ATOMIC_RELAXED);
    for (int index = 0; index < CORTEX_MARKS; ++index) {
        const uint64_t mark = __atomic_load_n(&ring->marks[index], __ATOMIC_RELAXED);
        if (mark >= oldest + reader->capacity / 4 && mark < best) best = mark;
    }
    cortex_reader_move(reader, best <= reader->tail || best > head ? head : best);
}

/* The next frame where it lies, to be copied before `cortex_reader_finish`; 0 if there is none, -1 if none will come, see `state`. */
static inline int64_t cortex_reader_peek(CortexReader *reader, const uint8_t **frame) {
    while (reader->state == CORTEX_SOUND) {
        if (reader->seen == reader->tail) reader->seen = __atomic_load_n(&reader->ring->head, __ATOMIC_ACQUIRE);
        const uint64_t left = reader->seen - reader->tail;
        uint32_t entry[2];
        if (!left) return 0;
        const uint8_t *place = reader->data + (reader->tail & (reader->capacity - 1));
        if (left <= reader->capacity) memcpy(entry, place, sizeof entry);
        if (left > reader->capacity || !cortex_reader_is_whole(reader)) {
            cortex_reader_skip(reader);
        } else if (entry[1] == CORTEX_MOVED) {
            if (cortex_reader_follow(reader) < 0) reader->state = CORTEX_ENDED;
        } else if (entry[1] != CORTEX_FRAME || !entry[0] || cortex_entry_bytes(entry[0]) > left) {
            reader->state = CORTEX_BROKEN;
        } else {
            *frame = place + CORTEX_ENTRY_BYTES;
            return entry[0];
        }
    }
    return -1;
}

/* Lease the slot that a frame names. CORTEX_COPY: the reader has enough of them, but may copy the
   message and then call `cortex_reader_has`; CORTEX_NO_SLOT: the frame is wrong. */
static inline int cortex_reader_lease(CortexReader *reader, uint64_t slot, uint64_t sequence, uint64_t size, CortexLease *lease) {
    CortexMap *map = reader->map;
    if (slot >= map->slot_count || size > map->slot_bytes) return CORTEX_NO_SLOT;
    lease->seat = reader->seat;
    lease->map = map;
    lease->slot = (uint32_t)slot;
    const uint64_t *word = &map->ring->words[slot];
    if (__atomic_load_n(&reader->page->leases[slot], __ATOMIC_RELAXED)) return CORTEX_NO_SLOT; /* it has a message of ours */
    if (__atomic_load_n(&reader->seat->held, __ATOMIC_RELAXED) >= __atomic_load_n(&map->ring->quota, __ATOMIC_RELAXED))
        return __atomic_load_n(word, __ATOMIC_ACQUIRE) == sequence + 1 ? CORTEX_COPY : CORTEX_OVERWRITTEN;
    __atomic_store_n(&reader->page->leases[slot], 1, __ATOMIC_RELAXED);
    __atomic_thread_fence(__ATOMIC_SEQ_CST); /* see `cortex_slot_take` */
    if (__atomic_load_n(word, __ATOMIC_ACQUIRE) != sequence + 1) {
        __atomic_store_n(&reader->page->leases[slot], 0, __ATOMIC_RELEASE);
        return CORTEX_OVERWRITTEN;
    }
    __atomic_fetch_add(&lease->seat->held, 1, __ATOMIC_RELAXED);
    __atomic_fetch_add(&lease->seat->users, 1, __ATOMIC_RELAXED);
    __atomic_fetch_add(&map->users, 1, __ATOMIC_RELAXED);
    return CORTEX_LEASED;
}

/* Whether a slot that was copied had this message all the time. */
static inline int cortex_reader_has(const CortexReader *reader, uint64_t slot, uint64_t sequence) {
    __atomic_thread_fence(__ATOMIC_ACQUIRE);
    return __atomic_load_n(&reader->map->ring->words[slot], __ATOMIC_RELAXED) == sequence + 1;
}

static inline void cortex_seat_lock(CortexSeat *seat) {
    while (__atomic_exchange_n(&seat->lock, 1, __ATOMIC_ACQUIRE)) cortex_yield();
}
static inline void cortex_seat_unlock(CortexSeat *seat) { __atomic_store_n(&seat->lock, 0, __ATOMIC_RELEASE); }

/* Give a slot back. In a forked child nothing is: the lease is the parent's. */
static inline void cortex_lease_end(const CortexLease *lease) {
    CortexSeat *seat = lease->seat;
    if (seat->process == cortex_process()) {
        cortex_seat_lock(seat); /* the reader may be going on to another ring, whose slots have the same numbers */
        if (seat->current == lease->map) __atomic_store_n(&seat->page->leases[lease->slot], 0, __ATOMIC_RELEASE);
        cortex_seat_unlock(seat);
    }
    __atomic_fetch_sub(&seat->held, 1, __ATOMIC_RELAXED);
    cortex_map_end(lease->map);
    cortex_seat_end(seat);
}

/* Let go of a body; any thread may. */
static inline void cortex_body_end(CortexBody *body) {
    if (body->is_leased) {
        cortex_lease_end(&body->lease);
    } else if (body->data != NULL) {
        __atomic_fetch_sub(&body->lease.seat->private_bytes, body->size, __ATOMIC_RELAXED);
        cortex_seat_end(body->lease.seat);
        free(body->data);
    }
    memset(body, 0, sizeof *body);
}

/* Copy what may not be leased: CORTEX_COPY, CORTEX_OVERWRITTEN, or CORTEX_CROWDED if too much is kept already. */
static inline int cortex_body_copy(const CortexReader *reader, CortexBody *body, uint64_t sequence) {
    CortexSeat *seat = reader->seat;
    const uint64_t many = CORTEX_PRIVATE_BYTES, most = body->size < many / 4 ? many : 4 * body->size;
    if (__atomic_load_n(&seat->private_bytes, __ATOMIC_RELAXED) + body->size > most) return CORTEX_CROWDED;
    body->data = (uint8_t *)malloc((size_t)cortex_most(body->size, 1));
    if (body->data == NULL) return CORTEX_CROWDED;
    body->lease.seat = seat;
    __atomic_fetch_add(&seat->users, 1, __ATOMIC_RELAXED);
    __atomic_fetch_add(&seat->private_bytes, body->size, __ATOMIC_RELAXED);
    cortex_copy(body->data, cortex_slot_memory(reader->map, (int)body->lease.slot), (size_t)body->size);
    return cortex_reader_has(reader, body->lease.slot, sequence) ? CORTEX_COPY : CORTEX_OVERWRITTEN;
}

/* Done with a frame that was copied from where `cortex_reader_peek` found it: 1. If it names a slot, `body` gets what is there; its
   data is NULL if there is nothing, as the frame is wrong. 0: frame or body were written over meanwhile. -1: the message has to
   wait until the user lets others go, or to be passed over. */
static inline int cortex_reader_finish(CortexReader *reader, const uint8_t *frame, int64_t size, CortexBody *body) {
    int found = CORTEX_NO_SLOT;
    memset(body, 0, sizeof *body);
    if (!cortex_reader_is_whole(reader)) return 0;
    if (size == CORTEX_FRAME_BYTES && frame[3] == 'S') {
        uint64_t rest[5]; /* sequence, two times, size, slot */
        memcpy(rest, frame + CORTEX_FRAME_BYTES - sizeof rest, sizeof rest);
        found = cortex_reader_lease(reader, rest[4], rest[0], rest[3], &body->lease);
        body->size = rest[3];
        body->is_leased = found == CORTEX_LEASED;
        if (body->is_leased) body->data = cortex_slot_memory(body->lease.map, (int)body->lease.slot);
        if (found == CORTEX_COPY) found = cortex_body_copy(reader, body, rest[0]);
        if (found == CORTEX_CROWDED) return -1;
        if (found == CORTEX_OVERWRITTEN) cortex_body_end(body);
    }
    cortex_reader_move(reader, reader->tail + cortex_entry_bytes((uint64_t)size));
    return found != CORTEX_OVERWRITTEN;
}

/* Leave out the message that has to wait. */
static inline void cortex_reader_pass_over(CortexReader *reader) {
    cortex_reader_move(reader, reader->tail + cortex_entry_bytes(CORTEX_FRAME_BYTES));
}

/* Have the wakeup signalled when a frame comes; 0 if one is there. To be called when none was. Who took `sleeping` back may
   signal later than we look: whoever finds nothing twice clears what was left of that. */
static inline int cortex_reader_arm(CortexReader *reader) {
    if (reader->armed) cortex_clear_wakeup(reader->wakeup);
    reader->armed = 1;
    if (!__atomic_load_n(&reader->page->sleeping, __ATOMIC_RELAXED)) {
        __atomic_store_n(&reader->page->sleeping, 1, __ATOMIC_RELAXED);
        __atomic_thread_fence(__ATOMIC_SEQ_CST); /* see `cortex_writer_wake` */
    }
    return __atomic_load_n(&reader->ring->head, __ATOMIC_ACQUIRE) == reader->tail;
}

/* Have it signalled no more; if it was, clear it. */
static inline void cortex_reader_disarm(CortexReader *reader) {
    if (!reader->armed) return;
    reader->armed = 0;
    if (!__atomic_exchange_n(&reader->page->sleeping, 0, __ATOMIC_ACQ_REL)) cortex_clear_wakeup(reader->wakeup);
}

#endif
