/* SPDX-License-Identifier: Apache-2.0
   What a publisher does with the slots of its ring; a part of `broadcast.h`. */

#ifndef CORTEX_BROADCAST_SLOTS_H
#define CORTEX_BROADCAST_SLOTS_H

static inline uint8_t *cortex_slot_memory(const CortexMap *map, int slot) { return map->slots + (uint64_t)slot * map->slot_bytes; }

/* Whether a reader looks at a slot, or a reliable one that is not lagging has not come to it. */
static inline int cortex_member_wants(CortexWriter *writer, CortexMember *member, int slot) {
    if (!member->used) return 0;
    if (member->strict && !member->lagging && !member->left && member->tail < writer->slots[slot].end) {
        member->tail = __atomic_load_n(&member->page->tail, __ATOMIC_ACQUIRE); /* what it leases before that, we see */
        if (member->tail < writer->slots[slot].end) return 1;
    }
    return __atomic_load_n(&member->page->generation, __ATOMIC_ACQUIRE) == writer->map->generation
        && __atomic_load_n(&member->page->leases[slot], __ATOMIC_ACQUIRE);
}

static inline int cortex_slot_is_wanted(CortexWriter *writer, int slot) {
    for (int index = 0; index < writer->count; ++index)
        if (cortex_member_wants(writer, &writer->members[index], slot)) return 1;
    return 0;
}

/* Whether every reader has come to a slot, lossy ones, too. */
static inline int cortex_slot_is_read(CortexWriter *writer, int slot) {
    for (int index = 0; index < writer->count; ++index) {
        CortexMember *member = &writer->members[index];
        if (!member->used || member->left || member->tail >= writer->slots[slot].end) continue;
        member->tail = __atomic_load_n(&member->page->tail, __ATOMIC_ACQUIRE);
        if (member->tail < writer->slots[slot].end) return 0;
    }
    return 1;
}

/* Take a slot to be written; 0 if somebody has just leased it. */
static inline int cortex_slot_take(CortexWriter *writer, int slot) {
    const uint64_t word = __atomic_load_n(&writer->ring->words[slot], __ATOMIC_RELAXED);
    __atomic_store_n(&writer->ring->words[slot], 0, __ATOMIC_RELAXED);
    __atomic_thread_fence(__ATOMIC_SEQ_CST); /* see `cortex_reader_lease` */
    if (cortex_slot_is_wanted(writer, slot)) {
        __atomic_store_n(&writer->ring->words[slot], word, __ATOMIC_RELEASE);
        return 0;
    }
    writer->slots[slot].busy = 1;
    writer->slots[slot].written = ++writer->clock;
    return 1;
}

/* A slot to write, until `cortex_slot_commit` or `cortex_slot_abandon`; -1 if none is free. Of those that all have read the
   one that was written last, as it is in the cache; else the one that was written first, so that who lags loses the oldest. */
static inline int cortex_slot_acquire(CortexWriter *writer) {
    cortex_writer_tidy(writer);
    for (uint64_t tries = 0; tries < 2 * writer->map->slot_count; ++tries) {
        int best = -1, best_is_read = 0;
        for (int slot = 0; slot < (int)writer->map->slot_count; ++slot) {
            const CortexSlot *known = &writer->slots[slot];
            if (known->busy || cortex_slot_is_wanted(writer, slot)) continue;
            const int is_read = cortex_slot_is_read(writer, slot);
            const int better = best < 0 || is_read > best_is_read
                || (is_read == best_is_read && (known->written > writer->slots[best].written) == is_read);
            if (!better) continue;
            best = slot;
            best_is_read = is_read;
        }
        if (best < 0) return -1;
        if (cortex_slot_take(writer, best)) return best;
    }
    return -1;
}

/* Whether a reliable reader has still to come to a slot: then one may become free when it has. */
static inline int cortex_member_is_behind(CortexWriter *writer, CortexMember *member) {
    if (!member->used || member->left || !member->strict || member->lagging) return 0;
    uint64_t end = 0;
    for (uint64_t slot = 0; slot < writer->map->slot_count; ++slot)
        if (writer->slots[slot].end > end) end = writer->slots[slot].end;
    if (member->tail >= end) return 0;
    member->tail = __atomic_load_n(&member->page->tail, __ATOMIC_ACQUIRE);
    if (member->tail < end) member->strict = !cortex_is_gone(member->socket);
    return member->strict && member->tail < end;
}

/* Whether a reliable reader has no room for a frame of a size, or with size 0 has not come to all slots. */
static inline int cortex_member_is_in_the_way(CortexWriter *writer, CortexMember *member, uint64_t size) {
    return size ? cortex_member_is_full(writer, member, cortex_entry_bytes(size) + CORTEX_SPARE_BYTES) : cortex_member_is_behind(writer, member);
}

/* The shortest time for which one that is in the way may hold up the publisher [ms]; -1: nobody is. */
static inline int64_t cortex_writer_patience(CortexWriter *writer, uint64_t size) {
    int64_t shortest = -1;
    for (int index = 0; index < writer->count; ++index) {
        CortexMember *member = &writer->members[index];
        if ((shortest < 0 || member->timeout_ms < shortest) && cortex_member_is_in_the_way(writer, member, size)) shortest = member->timeout_ms;
    }
    return shortest;
}

/* Wait no more for those that have been in the way for their time. */
static inline void cortex_writer_give_up(CortexWriter *writer, uint64_t size, int64_t waited_ms) {
    for (int index = 0; index < writer->count; ++index) {
        CortexMember *member = &writer->members[index];
        if (member->timeout_ms <= waited_ms && cortex_member_is_in_the_way(writer, member, size)) cortex_member_give_up(writer, member);
    }
}

static inline uint64_t cortex_most(uint64_t a, uint64_t b) { return a > b ? a : b; }
static inline uint64_t cortex_least(uint64_t a, uint64_t b) { return a < b ? a : b; }

/* Say how many slots each reader may lease, so that who keeps many messages takes none from the others. */
static inline void cortex_writer_share(CortexWriter *writer) {
    const uint64_t readers = cortex_writer_readers(writer);
    const uint64_t share = writer->map->slot_count < 2 ? 0 : (writer->map->slot_count - 1) / (readers ? readers : 1);
    __atomic_store_n(&writer->ring->quota, share ? share : 1, __ATOMIC_RELAXED);
}

/* How many slots of a size its readers want. */
static inline uint64_t cortex_slots_wanted(const CortexWriter *writer, uint64_t slot_bytes, int deep) {
    const uint64_t least = 2 * cortex_writer_readers(writer) + 2;
    return deep ? cortex_most(least, cortex_least(CORTEX_DEEP_SLOTS, CORTEX_DEEP_BYTES / cortex_most(slot_bytes, 1))) : least;
}

/* Make slots for bodies of a size, if need be: 1 if there are some; -1 if there are not, or not enough, as there is no memory.
   With `exact` all bodies have this size, and nothing is kept for growth; `deep`: a reader keeps many messages. */
static inline int cortex_writer_provide(CortexWriter *writer, uint64_t size, int exact, int deep) {
    const uint64_t before = writer->map->slot_bytes, count = writer->map->slot_count;
    const int fits = before >= size;
    if (fits && count >= cortex_slots_wanted(writer, before, deep)) return 1;
    uint64_t bytes = exact ? size : size + size / 4;
    if (count && !exact && !fits) bytes = cortex_most(bytes, size + cortex_least(size, CORTEX_SMALL_BYTES)); /* these are to last */
    bytes = cortex_most(cortex_most(bytes, before), 1); /* a message may be empty */
    bytes = (bytes + CORTEX_PAGE_BYTES - 1) / CORTEX_PAGE_BYTES * CORTEX_PAGE_BYTES;
    uint64_t slots = cortex_least(cortex_most(CORTEX_SMALL_BYTES / bytes, 4), 64);
    slots = cortex_most(slots, cortex_slots_wanted(writer, bytes, deep));
    slots = cortex_most(4, cortex_least(slots, ((uint64_t)2 << 30) / bytes));
    if (fits && count >= slots) return 1;
    return cortex_writer_grow(writer, writer->capacity, slots, bytes) == 0 ? 1 : -1;
}

static inline void cortex_slot_abandon(CortexWriter *writer, int slot) {
    writer->slots[slot].busy = 0;
    writer->slots[slot].end = 0;
}

/* Send the frame that names a slot which has been written; with CORTEX_FULL it is still to be sent. */
static inline int cortex_slot_commit(CortexWriter *writer, int slot, uint64_t sequence, const void *frame, size_t size, int all_or_none) {
    __atomic_store_n(&writer->ring->words[slot], sequence + 1, __ATOMIC_RELEASE);
    const uint64_t before = writer->head;
    const int found = cortex_writer_put(writer, frame, size, all_or_none);
    if (found == CORTEX_FULL) return found;
    writer->slots[slot].busy = 0;
    writer->slots[slot].end = writer->head == before ? 0 : writer->head;
    return found;
}

#endif
