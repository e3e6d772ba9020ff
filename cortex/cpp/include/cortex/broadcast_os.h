/* SPDX-License-Identifier: Apache-2.0
   What `broadcast.h` needs of the system: sealed memory, a socket that hands descriptors over, and wakeups. */

#ifndef CORTEX_BROADCAST_OS_H
#define CORTEX_BROADCAST_OS_H

#if defined(__linux__)

#include <fcntl.h>
#include <poll.h>
#include <sched.h>
#include <stdio.h>
#include <sys/eventfd.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/un.h>
#include <unistd.h>

#ifndef F_ADD_SEALS /* of <linux/fcntl.h>, which cannot be included with <fcntl.h> */
#define F_ADD_SEALS 1033
#define F_GET_SEALS 1034
#endif
enum { CORTEX_SEAL = 1, CORTEX_SEAL_SHRINK = 2, CORTEX_SEAL_GROW = 4, CORTEX_SEAL_FUTURE_WRITE = 16, CORTEX_DESCRIPTORS = 2 };

static inline void cortex_close_fd(int fd) {
    const int error = errno;
    if (fd >= 0) close(fd);
    errno = error;
}

static inline void cortex_signal_wakeup(int wakeup) {
    const uint64_t one = 1;
    if (write(wakeup, &one, sizeof one) < 0) return; /* it is signalled already */
}

static inline void cortex_clear_wakeup(int wakeup) {
    uint64_t count;
    if (read(wakeup, &count, sizeof count) < 0) return; /* it was not signalled */
}

/* Not by what can be read: who has said something before it died would be there for ever. */
static inline int cortex_is_gone(int socket) {
    struct pollfd look = {socket, 0, 0};
    return poll(&look, 1, 0) > 0;
}

/* Sealed memory of its own: nobody can change its size, and if `others_read` nobody else can write to it. */
static inline int cortex_memory(uint64_t bytes, int others_read) {
    const int fd = (int)syscall(SYS_memfd_create, "cortex", 3u /* MFD_CLOEXEC | MFD_ALLOW_SEALING */);
    if (fd < 0) return -1;
    errno = posix_fallocate(fd, 0, (off_t)bytes); /* a missing page is an error here, instead of SIGBUS later */
    const int seals = CORTEX_SEAL_SHRINK | CORTEX_SEAL_GROW | (others_read ? 0 : CORTEX_SEAL);
    if (errno || fcntl(fd, F_ADD_SEALS, seals) < 0) {
        cortex_close_fd(fd);
        return -1;
    }
    return fd;
}

/* Whether a descriptor is memory whose size is this and stays. */
static inline int cortex_is_memory(int fd, uint64_t bytes) {
    struct stat status;
    const int seals = fcntl(fd, F_GET_SEALS);
    return seals >= 0 && !(~seals & (CORTEX_SEAL_SHRINK | CORTEX_SEAL_GROW)) && fstat(fd, &status) == 0
        && (uint64_t)status.st_size == bytes;
}

static inline int cortex_process(void) { return (int)getpid(); }
static inline void cortex_yield(void) { sched_yield(); }

/* Map a ring; NULL if that cannot be done. */
static inline CortexMap *cortex_map_begin(int fd, uint64_t capacity, uint64_t slots, uint64_t slot_bytes, int protection) {
    const size_t whole = CORTEX_HEAD_BYTES + (size_t)capacity, bodies = (size_t)(slots * slot_bytes);
    CortexMap *map = (CortexMap *)calloc(1, sizeof *map);
    if (map == NULL) return NULL;
    uint8_t *base = (uint8_t *)mmap(NULL, whole + (size_t)capacity + bodies, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
    const int flags = MAP_SHARED | MAP_FIXED;
    map->ring = (CortexRing *)base;
    map->data = base + CORTEX_HEAD_BYTES;
    map->slots = base + whole + capacity;
    map->capacity = capacity;
    map->slot_count = slots;
    map->slot_bytes = slot_bytes;
    map->users = 1;
    if (base != MAP_FAILED && mmap(base, whole, protection, flags, fd, 0) != MAP_FAILED
        && mmap(base + whole, (size_t)capacity, protection, flags, fd, CORTEX_HEAD_BYTES) != MAP_FAILED
        && (!bodies || mmap(map->slots, bodies, protection, flags | MAP_POPULATE, fd, (off_t)whole) != MAP_FAILED))
        return map;
    if (base != MAP_FAILED) munmap(base, whole + (size_t)capacity + bodies);
    free(map);
    return NULL;
}

static inline void cortex_map_end(CortexMap *map) {
    if (map == NULL || __atomic_sub_fetch(&map->users, 1, __ATOMIC_ACQ_REL)) return;
    munmap(map->ring, CORTEX_HEAD_BYTES + 2 * (size_t)map->capacity + (size_t)(map->slot_count * map->slot_bytes));
    free(map);
}

static inline void cortex_seat_end(CortexSeat *seat) {
    if (seat == NULL || __atomic_sub_fetch(&seat->users, 1, __ATOMIC_ACQ_REL)) return;
    if (seat->page != NULL) munmap(seat->page, CORTEX_PAGE_BYTES);
    cortex_close_fd(seat->socket);
    free(seat);
}

/* Whether so much memory is to be had: what is missing later would not be an error, but end some process. */
static inline int cortex_has_memory(uint64_t bytes) {
    char line[128];
    unsigned long long kilobytes = 0;
    FILE *file = fopen("/proc/meminfo", "re");
    if (file == NULL) return 1;
    int found = 0;
    while (!found && fgets(line, sizeof line, file) != NULL) found = sscanf(line, "MemAvailable: %llu", &kilobytes) == 1;
    fclose(file);
    errno = ENOMEM;
    return !found || bytes / 1024 < kilobytes;
}

/* Send a message with descriptors. */
static inline int cortex_send(int socket, const void *data, size_t size, const int *fds, int count) {
    union {
        struct cmsghdr head;
        char space[CMSG_SPACE(CORTEX_DESCRIPTORS * sizeof(int))];
    } control;
    struct iovec part;
    struct msghdr message;
    memset(&control, 0, sizeof control);
    memset(&message, 0, sizeof message);
    part.iov_base = (void *)(uintptr_t)data;
    part.iov_len = size;
    message.msg_iov = &part;
    message.msg_iovlen = 1;
    message.msg_control = control.space;
    message.msg_controllen = CMSG_SPACE((size_t)count * sizeof(int));
    struct cmsghdr *head = CMSG_FIRSTHDR(&message);
    head->cmsg_level = SOL_SOCKET;
    head->cmsg_type = SCM_RIGHTS;
    head->cmsg_len = CMSG_LEN((size_t)count * sizeof(int));
    memcpy(CMSG_DATA(head), fds, (size_t)count * sizeof(int));
    return sendmsg(socket, &message, MSG_DONTWAIT | MSG_NOSIGNAL) == (ssize_t)size ? 0 : -1;
}

/* Receive a message with just so many descriptors. */
static inline int cortex_receive(int socket, void *data, size_t size, int *fds, int count) {
    union {
        struct cmsghdr head;
        char space[CMSG_SPACE(CORTEX_DESCRIPTORS * sizeof(int))];
    } control;
    struct iovec part = {data, size};
    struct msghdr message;
    memset(&message, 0, sizeof message);
    message.msg_iov = &part;
    message.msg_iovlen = 1;
    message.msg_control = control.space;
    message.msg_controllen = sizeof control.space;
    const ssize_t got = recvmsg(socket, &message, MSG_DONTWAIT | MSG_CMSG_CLOEXEC);
    if (got < 0) return -1;
    int found = 0;
    for (struct cmsghdr *head = CMSG_FIRSTHDR(&message); head != NULL; head = CMSG_NXTHDR(&message, head)) {
        if (head->cmsg_level != SOL_SOCKET || head->cmsg_type != SCM_RIGHTS) continue;
        const int more = (int)((head->cmsg_len - CMSG_LEN(0)) / sizeof(int));
        for (int index = 0; index < more; ++index, ++found) {
            int fd;
            memcpy(&fd, CMSG_DATA(head) + (size_t)index * sizeof(int), sizeof fd);
            if (found < count) fds[found] = fd;
            else close(fd);
        }
    }
    if ((size_t)got == size && found == count) return 0;
    for (int index = 0; index < found && index < count; ++index) close(fds[index]);
    errno = EPROTO;
    return -1;
}

/* Whether the other end belongs to our user. */
static inline int cortex_is_ours(int socket) {
    struct ucred peer;
    socklen_t size = sizeof peer;
    return getsockopt(socket, SOL_SOCKET, SO_PEERCRED, &peer, &size) == 0 && peer.uid == geteuid();
}

/* A socket, and the address of a path. */
static inline int cortex_socket(const char *path, struct sockaddr_un *address) {
    memset(address, 0, sizeof *address);
    address->sun_family = AF_UNIX;
    if (strlen(path) >= sizeof address->sun_path) {
        errno = ENAMETOOLONG;
        return -1;
    }
    strcpy(address->sun_path, path);
    return socket(AF_UNIX, SOCK_SEQPACKET | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
}

static inline int cortex_listen(const char *path) {
    struct sockaddr_un address;
    const int fd = cortex_socket(path, &address);
    if (fd < 0) return -1;
    if (bind(fd, (struct sockaddr *)&address, sizeof address) == 0 && listen(fd, 1024) == 0) return fd;
    cortex_close_fd(fd);
    return -1;
}

static inline int cortex_accept(int listener) {
    const int fd = accept4(listener, NULL, NULL, SOCK_NONBLOCK | SOCK_CLOEXEC);
    if (fd < 0 || cortex_is_ours(fd)) return fd;
    close(fd);
    errno = EACCES;
    return -1;
}

/* Whether this can be a wakeup descriptor: a pipe or a socket that nobody reads would send us a signal that ends the process. */
static inline int cortex_is_wakeup(int fd) {
    struct stat status;
    return fstat(fd, &status) == 0 && !S_ISFIFO(status.st_mode) && !S_ISSOCK(status.st_mode) && fcntl(fd, F_SETFL, O_NONBLOCK) == 0;
}

/* Whether this is the magic of a ring of an older or newer kind: only the last letter differs. */
static inline int cortex_is_other_version(uint64_t magic) { return magic != CORTEX_RING_MAGIC && !((magic ^ CORTEX_RING_MAGIC) << 8); }

static inline int cortex_hear(int socket, CortexHello *hello) {
    uint64_t said[3];
    int fds[2];
    if (cortex_receive(socket, said, sizeof said, fds, 2) < 0) return -1;
    hello->source = said[1];
    hello->reader = said[2];
    hello->socket = socket;
    hello->page = fds[0];
    hello->wakeup = fds[1];
    if (said[0] == CORTEX_RING_MAGIC && cortex_is_memory(fds[0], CORTEX_PAGE_BYTES) && cortex_is_wakeup(fds[1])) return 0;
    close(fds[0]);
    close(fds[1]);
    errno = cortex_is_other_version(said[0]) ? EPROTONOSUPPORT : EPROTO;
    return -1;
}

/* Make memory for a ring that goes on at the writer's head; the writer is as it was if there is none. */
static inline int cortex_writer_make(CortexWriter *writer, uint64_t capacity, uint64_t slots, uint64_t slot_bytes) {
    const uint64_t bytes = CORTEX_HEAD_BYTES + capacity + slots * slot_bytes;
    const int fd = cortex_has_memory(bytes) ? cortex_memory(bytes, 1) : -1;
    CortexMap *map = fd < 0 ? NULL : cortex_map_begin(fd, capacity, slots, slot_bytes, PROT_READ | PROT_WRITE);
    if (map == NULL) {
        cortex_close_fd(fd);
        return -1;
    }
    if (fcntl(fd, F_ADD_SEALS, CORTEX_SEAL_FUTURE_WRITE | CORTEX_SEAL) < 0) fcntl(fd, F_ADD_SEALS, CORTEX_SEAL); /* Linux < 5.1 */
    CortexRing *ring = map->ring;
    ring->magic = CORTEX_RING_MAGIC;
    ring->capacity = capacity;
    ring->source = writer->source;
    ring->generation = map->generation = writer->map == NULL ? 1 : writer->map->generation + 1;
    ring->slots = slots;
    ring->slot_bytes = slot_bytes;
    ring->reserved = ring->head = ring->last = writer->head;
    writer->map = map;
    writer->ring = ring;
    writer->data = map->data;
    writer->capacity = capacity;
    writer->fd = fd;
    writer->narrow = 0;
    memset(writer->slots, 0, sizeof writer->slots);
    cortex_writer_share(writer);
    return 0;
}

static inline int cortex_writer_open(CortexWriter *writer, uint64_t source, uint64_t capacity) {
    memset(writer, 0, sizeof *writer);
    writer->source = source;
    return cortex_writer_make(writer, capacity, 0, 0);
}

/* Tell a reader where the ring is. */
static inline int cortex_welcome(const CortexWriter *writer, int socket, uint64_t first) {
    const uint64_t said[7] = {CORTEX_RING_MAGIC, writer->capacity, writer->source, writer->head, first,
                              writer->map->slot_count, writer->map->slot_bytes};
    return cortex_send(socket, said, sizeof said, &writer->fd, 1);
}

static inline void cortex_hello_close(const CortexHello *hello) {
    cortex_close_fd(hello->page);
    cortex_close_fd(hello->wakeup);
    cortex_close_fd(hello->socket);
}

static inline int cortex_writer_add(CortexWriter *writer, const CortexHello *hello, int strict, uint32_t timeout_ms, uint64_t first) {
    int number = 0;
    while (number < writer->count && writer->members[number].used) ++number;
    void *page = MAP_FAILED;
    if (number < CORTEX_MEMBERS)
        page = mmap(NULL, CORTEX_PAGE_BYTES, PROT_READ | PROT_WRITE, MAP_SHARED, hello->page, 0);
    if (page == MAP_FAILED || cortex_welcome(writer, hello->socket, first) < 0) {
        if (page != MAP_FAILED) munmap(page, CORTEX_PAGE_BYTES);
        cortex_hello_close(hello);
        return -1;
    }
    cortex_close_fd(hello->page);
    CortexMember *member = &writer->members[number];
    member->used = 1;
    member->strict = strict;
    member->timeout_ms = timeout_ms;
    member->lagging = member->left = 0;
    member->socket = hello->socket;
    member->wakeup = hello->wakeup;
    member->page = (CortexPage *)page;
    member->tail = writer->head;
    __atomic_store_n(&member->page->tail, writer->head, __ATOMIC_RELEASE);
    if (number == writer->count) ++writer->count;
    cortex_writer_share(writer);
    return number;
}

static inline void cortex_writer_forget(CortexWriter *writer, int number) {
    CortexMember *member = &writer->members[number];
    if (!member->used) return;
    member->used = 0;
    munmap(member->page, CORTEX_PAGE_BYTES);
    close(member->wakeup);
    close(member->socket);
}

static inline void cortex_writer_remove(CortexWriter *writer, int number) {
    writer->members[number].left = 1;
    cortex_writer_tidy(writer);
    cortex_writer_share(writer);
}

/* Go on in another ring: each reader gets it through its socket, and looks there after what is in the old one. Nothing
   is written to the old one any more, slots included. */
static inline int cortex_writer_grow(CortexWriter *writer, uint64_t capacity, uint64_t slots, uint64_t slot_bytes) {
    errno = EINVAL;
    if (capacity > (uint64_t)1 << 32 || slots > CORTEX_SLOTS || slot_bytes > (uint64_t)1 << 32) return -1;
    CortexMap *before = writer->map;
    CortexRing *ring = writer->ring;
    const int fd = writer->fd;
    const uint64_t head = writer->head, old_capacity = writer->capacity;
    writer->head = head + CORTEX_ENTRY_BYTES;
    if (cortex_writer_make(writer, capacity, slots, slot_bytes) < 0) {
        writer->head = head;
        return -1;
    }
    for (int index = 0; index < writer->count; ++index) {
        CortexMember *member = &writer->members[index];
        if (member->used && member->left) cortex_writer_forget(writer, index);
        if (!member->used || cortex_welcome(writer, member->socket, 0) == 0) continue;
        shutdown(member->socket, SHUT_RDWR); /* then it attaches anew */
        member->lagging = 1;
    }
    cortex_ring_move(ring, before->data, old_capacity, head); /* the spare bytes have room for it */
    cortex_writer_wake(writer);
    cortex_map_end(before);
    close(fd);
    return 0;
}

static inline void cortex_writer_close(CortexWriter *writer) {
    for (int index = 0; index < writer->count; ++index) cortex_writer_forget(writer, index);
    if (writer->map != NULL) close(writer->fd);
    cortex_map_end(writer->map);
    writer->map = NULL;
    writer->ring = NULL;
}

/* Take the ring that the publisher hands over, instead of the one there is; 0 if none has come, -1 if it is none. */
static inline int cortex_reader_map(CortexReader *reader) {
    uint64_t said[7];
    int fd;
    if (cortex_receive(reader->socket, said, sizeof said, &fd, 1) < 0) return errno == EAGAIN ? 0 : -1;
    const uint64_t capacity = said[1], slots = said[5], slot_bytes = said[6];
    CortexMap *map = NULL;
    if (said[0] == CORTEX_RING_MAGIC && said[2] == reader->source && capacity >= CORTEX_HEAD_BYTES
        && capacity <= (uint64_t)1 << 32 && !(capacity & (capacity - 1)) && slots <= CORTEX_SLOTS
        && slot_bytes <= (uint64_t)1 << 32 && slot_bytes % CORTEX_PAGE_BYTES == 0
        && cortex_is_memory(fd, CORTEX_HEAD_BYTES + capacity + slots * slot_bytes))
        map = cortex_map_begin(fd, capacity, slots, slot_bytes, PROT_READ);
    close(fd);
    if (map == NULL) return -1;
    map->generation = __atomic_load_n(&map->ring->generation, __ATOMIC_RELAXED);
    if (reader->map == NULL) reader->first = said[4];
    cortex_seat_lock(reader->seat);
    for (int slot = 0; slot < CORTEX_SLOTS; ++slot) __atomic_store_n(&reader->page->leases[slot], 0, __ATOMIC_RELAXED);
    __atomic_store_n(&reader->page->generation, map->generation, __ATOMIC_RELEASE);
    reader->seat->current = map;
    cortex_seat_unlock(reader->seat);
    cortex_map_end(reader->map);
    reader->map = map;
    reader->ring = map->ring;
    reader->data = map->data;
    reader->capacity = capacity;
    reader->seen = said[3];
    cortex_reader_move(reader, said[3]);
    return 1;
}

static inline int cortex_reader_welcomed(CortexReader *reader) { return cortex_reader_map(reader); }
static inline int cortex_reader_follow(CortexReader *reader) { return cortex_reader_map(reader) > 0 ? 0 : -1; }

static inline void cortex_reader_close(CortexReader *reader) {
    cortex_map_end(reader->map);
    cortex_close_fd(reader->wakeup);
    cortex_seat_end(reader->seat);
    reader->map = NULL;
    reader->ring = NULL;
    reader->seat = NULL;
    reader->page = NULL;
    reader->wakeup = reader->socket = -1;
}

static inline int cortex_reader_open(CortexReader *reader, const char *path, uint64_t source, uint64_t number) {
    struct sockaddr_un address;
    memset(reader, 0, sizeof *reader);
    reader->source = source;
    reader->wakeup = reader->socket = -1;
    CortexSeat *seat = reader->seat = (CortexSeat *)calloc(1, sizeof *seat);
    if (seat == NULL) return -1;
    seat->users = 1;
    seat->process = cortex_process();
    seat->socket = reader->socket = cortex_socket(path, &address);
    const int page = cortex_memory(CORTEX_PAGE_BYTES, 0);
    if (reader->socket < 0 || page < 0) goto failed;
    {
        void *memory = mmap(NULL, CORTEX_PAGE_BYTES, PROT_READ | PROT_WRITE, MAP_SHARED, page, 0);
        if (memory == MAP_FAILED) goto failed;
        seat->page = reader->page = (CortexPage *)memory;
    }
    reader->wakeup = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);
    if (reader->wakeup < 0 || connect(reader->socket, (struct sockaddr *)&address, sizeof address) < 0) goto failed;
    {
        const uint64_t said[3] = {CORTEX_RING_MAGIC, source, number};
        const int fds[2] = {page, reader->wakeup};
        if (!cortex_is_ours(reader->socket) || cortex_send(reader->socket, said, sizeof said, fds, 2) < 0) goto failed;
    }
    close(page);
    return 0;
failed:
    cortex_close_fd(page);
    cortex_reader_close(reader);
    return -1;
}

#else /* no memfd: frames go through sockets */

static inline int cortex_unsupported(void) {
    errno = ENOSYS;
    return -1;
}
static inline int cortex_is_gone(int socket) { return (void)socket, 0; }
static inline void cortex_signal_wakeup(int wakeup) { (void)wakeup; }
static inline void cortex_clear_wakeup(int wakeup) { (void)wakeup; }
static inline int cortex_listen(const char *path) { return (void)path, cortex_unsupported(); }
static inline int cortex_accept(int listener) { return (void)listener, cortex_unsupported(); }
static inline int cortex_hear(int socket, CortexHello *hello) { return (void)socket, (void)hello, cortex_unsupported(); }
static inline void cortex_hello_close(const CortexHello *hello) { (void)hello; }
static inline int cortex_writer_open(CortexWriter *writer, uint64_t source, uint64_t capacity) {
    return (void)writer, (void)source, (void)capacity, cortex_unsupported();
}
static inline int cortex_writer_add(CortexWriter *writer, const CortexHello *hello, int strict, uint32_t timeout_ms, uint64_t first) {
    return (void)writer, (void)hello, (void)strict, (void)timeout_ms, (void)first, cortex_unsupported();
}
static inline void cortex_writer_remove(CortexWriter *writer, int member) { (void)writer, (void)member; }
static inline void cortex_writer_forget(CortexWriter *writer, int member) { (void)writer, (void)member; }
static inline int cortex_writer_grow(CortexWriter *writer, uint64_t capacity, uint64_t slots, uint64_t slot_bytes) {
    return (void)writer, (void)capacity, (void)slots, (void)slot_bytes, cortex_unsupported();
}
static inline void cortex_writer_close(CortexWriter *writer) { (void)writer; }
static inline int cortex_reader_open(CortexReader *reader, const char *path, uint64_t source, uint64_t number) {
    return (void)reader, (void)path, (void)source, (void)number, cortex_unsupported();
}
static inline int cortex_reader_welcomed(CortexReader *reader) { return (void)reader, 0; }
static inline int cortex_reader_follow(CortexReader *reader) { return (void)reader, cortex_unsupported(); }
static inline void cortex_reader_close(CortexReader *reader) { (void)reader; }
static inline void cortex_map_end(CortexMap *map) { (void)map; }
static inline void cortex_seat_end(CortexSeat *seat) { (void)seat; }
static inline int cortex_process(void) { return 0; }
static inline void cortex_yield(void) {}

#endif
#endif
