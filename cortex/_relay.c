/* One publisher's pipes to many readers, written by a thread of their own; see `pipe.py`.

   Who writes each message into each pipe himself wakes every reader for every message: on a busy machine each of
   them then interrupts the publisher, reads one message and goes back to sleep. Here the publisher appends frames to
   a ring and goes on. The thread writes to one reader after the other whatever has come for it since: the longer a
   round takes, the more frames each write carries.

   Each member has a place in the ring up to which it has been written. One that falls behind by the whole ring
   cannot stay attached to it: a reliable one holds up the publisher (`Again`) until `give_up`; then, as a lossy one at
   once, it gets what waits for it as a copy of its own, and loses what comes until half of that is written.

   The lock is held for moments only, never while writing, and whoever holds it is as urgent as who waits for it (the
   publisher does, with the GIL). The thread is as urgent as who publishes. It knows nothing of Python. */

#include "_native.h"

#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <poll.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/uio.h>
#include <unistd.h>

enum {
    MEMBERS_MAX = 64,
    RING_BYTES = 1 << 18,
    WRITE_BYTES = 1 << 16, /* at a time, so that no reader waits long for its turn; what a reader reads at a time */
    STACK_BYTES = 1 << 18,
    PARTS = 3,
};

typedef struct {
    int fd; /* -1: nobody */
    int strict;
    int detached; /* loses what comes: it has a copy of what waited for it, or its pipe is full */
    int full;     /* had no room at the last write */
    int dead;     /* takes everything: whoever reads it will be removed */
    int writing;  /* by the thread, which does not hold the lock: its part of the ring must stay */
    uint64_t sent; /* place in the stream up to which it was written */
    char *rest;    /* to be written before what is in the ring */
    size_t rest_size, rest_at;
} Member;

typedef struct {
    PyObject_HEAD
    PyObject *again;
    pid_t owner; /* the thread lives in this process only */
    pthread_t thread;
    int started, closed, adopted;
    pthread_mutex_t lock; /* of all that follows */
    pthread_cond_t written;
    Member members[MEMBERS_MAX];
    int used; /* those from here on are nobody */
    char *ring;
    size_t capacity;
    uint64_t head; /* bytes put into the ring so far */
    int wake_read, wake_write;
    int sleeping; /* the thread waits for a frame */
    int stopping;
} Relay;

static int is_behind(const Relay *relay, const Member *member) {
    return member->fd >= 0 && !member->dead
           && (member->rest_at < member->rest_size || member->sent < relay->head || member->detached);
}

static void drop_rest(Member *member) {
    free(member->rest);
    member->rest = NULL;
    member->rest_size = member->rest_at = 0;
}

/* Where bytes of the ring lie: one or two parts, whose number is returned. */
static int locate(const Relay *relay, uint64_t from, size_t size, struct iovec *parts) {
    const size_t at = (size_t)(from % relay->capacity), first = relay->capacity - at;
    parts[0] = (struct iovec){relay->ring + at, size < first ? size : first};
    parts[1] = (struct iovec){relay->ring, size < first ? 0 : size - first};
    return parts[1].iov_len ? 2 : 1;
}

/* The thread */

/* What to write to a member next; the number of parts. */
static int next_parts(const Relay *relay, const Member *member, struct iovec *parts) {
    size_t left = WRITE_BYTES;
    int count = 0;
    if (member->rest_at < member->rest_size) {
        const size_t size = member->rest_size - member->rest_at;
        parts[count++] = (struct iovec){member->rest + member->rest_at, size < left ? size : left};
        left -= parts[0].iov_len;
    }
    const uint64_t waiting = relay->head - member->sent;
    if (left && waiting) count += locate(relay, member->sent, waiting < left ? (size_t)waiting : left, parts + count);
    return count;
}

static void note_written(Member *member, size_t written) {
    const size_t rest = member->rest_size - member->rest_at, of_rest = written < rest ? written : rest;
    member->rest_at += of_rest;
    member->sent += written - of_rest;
    if (member->detached && member->rest_at >= member->rest_size / 2) member->detached = 0;
    if (member->rest != NULL && member->rest_at == member->rest_size) drop_rest(member);
}

/* Write to a member what there is room for; the lock is held before and after. */
static void serve(Relay *relay, Member *member) {
    struct iovec parts[PARTS];
    const int count = next_parts(relay, member, parts);
    if (!count) { /* nothing waits for it, and its pipe has room */
        note_written(member, 0);
        return;
    }
    size_t wanted = 0;
    for (int part = 0; part < count; ++part) wanted += parts[part].iov_len;
    const int fd = member->fd;
    member->writing = 1;
    pthread_mutex_unlock(&relay->lock);
    ssize_t written;
    do written = writev(fd, parts, count);
    while (written < 0 && errno == EINTR);
    const int failed = written < 0 && errno != EAGAIN && errno != EWOULDBLOCK;
    pthread_mutex_lock(&relay->lock);
    member->writing = 0;
    pthread_cond_broadcast(&relay->written);
    member->dead = failed;
    member->full = written < (ssize_t)wanted;
    if (written > 0) note_written(member, (size_t)written);
}

/* Sleep until there is a frame, or room in a full pipe; the lock is held before and after. */
static void await_work(Relay *relay) {
    struct pollfd sources[MEMBERS_MAX + 1] = {{relay->wake_read, POLLIN, 0}};
    int places[MEMBERS_MAX + 1], count = 1, hungry = 0;
    for (int place = 0; place < relay->used; ++place) {
        const Member *member = &relay->members[place];
        const int waits = member->full && is_behind(relay, member);
        hungry |= member->fd >= 0 && !member->dead && !waits;
        if (!waits) continue;
        places[count] = place;
        sources[count++] = (struct pollfd){member->fd, POLLOUT, 0};
    }
    relay->sleeping = hungry; /* where all are full a frame is no reason to wake up */
    pthread_mutex_unlock(&relay->lock);
    poll(sources, (nfds_t)count, -1);
    if (sources[0].revents) {
        char bytes[64];
        while (read(relay->wake_read, bytes, sizeof bytes) == sizeof bytes) continue;
    }
    pthread_mutex_lock(&relay->lock);
    relay->sleeping = 0;
    for (int source = 1; source < count; ++source) {
        if (sources[source].revents) relay->members[places[source]].full = 0;
    }
}

static void *run(void *argument) {
    Relay *relay = argument;
    pthread_mutex_lock(&relay->lock);
    while (!relay->stopping) {
        int served = 0;
        for (int place = 0; place < relay->used && !relay->stopping; ++place) {
            Member *member = &relay->members[place];
            if (!is_behind(relay, member) || member->full) continue;
            serve(relay, member);
            served = 1;
        }
        if (!served) await_work(relay);
    }
    pthread_mutex_unlock(&relay->lock);
    return NULL;
}

/* Start the thread, which handles no signals; 0 with `errno` set if that cannot be done. */
static int start(Relay *relay) {
    sigset_t all, before;
    pthread_attr_t attributes;
    sigfillset(&all);
    const int faults[] = {SIGSEGV, SIGBUS, SIGFPE, SIGILL};
    for (size_t index = 0; index < sizeof faults / sizeof *faults; ++index) sigdelset(&all, faults[index]);
    pthread_attr_init(&attributes);
    pthread_attr_setstacksize(&attributes, STACK_BYTES < PTHREAD_STACK_MIN ? PTHREAD_STACK_MIN : STACK_BYTES);
    pthread_sigmask(SIG_SETMASK, &all, &before);
    const int failed = pthread_create(&relay->thread, &attributes, run, relay);
    pthread_sigmask(SIG_SETMASK, &before, NULL);
    pthread_attr_destroy(&attributes);
    relay->started = !failed;
    errno = failed;
    return !failed;
}

/* The publisher's side; the lock is held but for the first */

static void wake(Relay *relay) {
    const ssize_t written = write(relay->wake_write, "", 1); /* full: it is awake */
    (void)written;
}

/* Give a member what waits for it as a copy of its own, so that its part of the ring is free; 0: no memory. */
static int detach(Relay *relay, Member *member) {
    while (member->writing) pthread_cond_wait(&relay->written, &relay->lock); /* one write, which never blocks */
    const size_t old = member->rest_size - member->rest_at, waiting = (size_t)(relay->head - member->sent);
    char *copy = malloc(old + waiting + 1);
    if (copy == NULL) return 0;
    if (old) memcpy(copy, member->rest + member->rest_at, old);
    if (waiting) {
        struct iovec parts[2];
        const int count = locate(relay, member->sent, waiting, parts);
        memcpy(copy + old, parts[0].iov_base, parts[0].iov_len);
        if (count == 2) memcpy(copy + old + parts[0].iov_len, parts[1].iov_base, parts[1].iov_len);
    }
    drop_rest(member);
    member->rest = copy;
    member->rest_size = old + waiting;
    member->sent = relay->head;
    member->detached = member->rest_size > 0;
    return 1;
}

/* Whether a member's part of the ring leaves no room for a frame. */
static int is_in_the_way(const Relay *relay, const Member *member, size_t size) {
    const size_t most = size < relay->capacity ? relay->capacity - size : 0;
    return member->fd >= 0 && !member->dead && relay->head - member->sent > most;
}

/* Make the thread as urgent as the caller; where that is not allowed it stays as it is. */
static void adopt(Relay *relay) {
    relay->adopted = 1;
#ifdef __linux__
    struct sched_param parameters;
    const int policy = sched_getscheduler(0); /* of this thread; what pthread_getschedparam says may be out of date */
    if (policy >= 0 && sched_getparam(0, &parameters) == 0) (void)pthread_setschedparam(relay->thread, policy, &parameters);
#endif
}

static int is_late(const Member *member) { return member->fd >= 0 && member->strict && member->detached && !member->dead; }

static int any_late(const Relay *relay) {
    for (int place = 0; place < relay->used; ++place) {
        if (is_late(&relay->members[place])) return 1;
    }
    return 0;
}

/* Another ring for an unusual frame, or the usual one again; it must be empty. 0: no memory. */
static int resize(Relay *relay, size_t size) {
    const size_t wanted = size > RING_BYTES ? size : RING_BYTES;
    if (wanted == relay->capacity || (wanted < relay->capacity && size > RING_BYTES)) return 1;
    char *other = malloc(wanted);
    if (other == NULL) return 0;
    free(relay->ring);
    relay->ring = other;
    relay->capacity = wanted;
    return 1;
}

static int is_empty(const Relay *relay) {
    for (int place = 0; place < relay->used; ++place) {
        const Member *member = &relay->members[place];
        if (member->fd >= 0 && !member->dead && member->sent < relay->head) return 0;
    }
    return 1;
}

/* Make room for a frame: 1; 0: a reliable member is in the way; -1: no memory. */
static int make_room(Relay *relay, size_t size) {
    for (int place = 0; place < relay->used; ++place) {
        const Member *member = &relay->members[place];
        if (member->strict && is_in_the_way(relay, member, size)) return 0;
    }
    for (int place = 0; place < relay->used; ++place) {
        Member *member = &relay->members[place];
        if (is_in_the_way(relay, member, size) && !detach(relay, member)) return -1;
    }
    if (size <= relay->capacity && relay->capacity <= RING_BYTES) return 1;
    return !is_empty(relay) || resize(relay, size) ? 1 : -1;
}

static void append(Relay *relay, const char *data, size_t size) {
    struct iovec parts[2];
    const int count = locate(relay, relay->head, size, parts);
    memcpy(parts[0].iov_base, data, parts[0].iov_len);
    if (count == 2) memcpy(parts[1].iov_base, data + parts[0].iov_len, parts[1].iov_len);
    relay->head += size;
    for (int place = 0; place < relay->used; ++place) {
        Member *member = &relay->members[place];
        if (member->detached || member->dead) member->sent = relay->head;
    }
}

/* What Python sees */

/* Put a frame into the ring: True, or False if a reliable member that is late loses it; `again` if it has no place. */
static PyObject *put(Relay *relay, PyObject *frame, int while_late) {
    if (relay->closed) Py_RETURN_TRUE;
    if (!relay->adopted) adopt(relay);
    const size_t size = (size_t)PyBytes_GET_SIZE(frame);
    pthread_mutex_lock(&relay->lock);
    const int late = any_late(relay);
    const int room = late && !while_late ? 0 : make_room(relay, size);
    if (room > 0) append(relay, PyBytes_AS_STRING(frame), size);
    const int sleeping = relay->sleeping && room > 0;
    if (sleeping) relay->sleeping = 0;
    pthread_mutex_unlock(&relay->lock);
    if (sleeping) wake(relay); /* not with the lock, which the thread takes first */
    if (room < 0) return PyErr_NoMemory();
    if (room > 0) return PyBool_FromLong(!late);
    PyErr_SetNone(relay->again);
    return NULL;
}

PyDoc_STRVAR(send_doc,
"send($self, frame, flags=0, /)\n--\n\n"
"Have a frame written to all; `again`, if a reliable member has no room or is late.");

static PyObject *relay_send(Relay *relay, PyObject *const *arguments, Py_ssize_t count) {
    PyObject *frame = frame_argument(arguments, count);
    return frame == NULL ? NULL : put(relay, frame, 0);
}

PyDoc_STRVAR(offer_doc,
"offer($self, frame, flags=0, /)\n--\n\n"
"As `send`, but do not mind who is late; False if somebody is, and loses it.");

static PyObject *relay_offer(Relay *relay, PyObject *const *arguments, Py_ssize_t count) {
    PyObject *frame = frame_argument(arguments, count);
    return frame == NULL ? NULL : put(relay, frame, 1);
}

PyDoc_STRVAR(add_doc,
"add($self, fd, left, strict, late, /)\n--\n\n"
"Write to one more pipe, from the next frame on.\n\n"
"Args:\n"
"    fd: Its descriptor, non-blocking; belongs to the relay from now on, unless this raises.\n"
"    left: Bytes to be written there first.\n"
"    strict: Whether it holds up the publisher.\n"
"    late: Whether it loses what comes until it has read some of what waits.\n\n"
"Returns:\n"
"    Its number, for `remove`.\n");

static PyObject *relay_add(Relay *relay, PyObject *arguments) {
    int fd, strict, late;
    const char *left;
    Py_ssize_t size;
    if (!PyArg_ParseTuple(arguments, "iy#pp:add", &fd, &left, &size, &strict, &late)) return NULL;
    if (relay->closed) {
        PyErr_SetString(PyExc_ValueError, "the relay is closed");
        return NULL;
    }
    char *copy = malloc((size_t)size + 1);
    if (copy == NULL) return PyErr_NoMemory();
    memcpy(copy, left, (size_t)size);
    int place = 0;
    pthread_mutex_lock(&relay->lock);
    while (place < MEMBERS_MAX && relay->members[place].fd >= 0) ++place;
    if (place < MEMBERS_MAX) {
        if (place == relay->used) relay->used += 1;
        relay->members[place] = (Member){.fd = fd, .strict = strict, .detached = late, .full = late, .sent = relay->head,
                                         .rest = copy, .rest_size = (size_t)size};
        wake(relay);
    }
    pthread_mutex_unlock(&relay->lock);
    if (place < MEMBERS_MAX) return PyLong_FromLong(place);
    free(copy);
    PyErr_Format(PyExc_ValueError, "a relay has at most %d members", MEMBERS_MAX);
    return NULL;
}

static void forget(Member *member) {
    drop_rest(member);
    *member = (Member){.fd = -1};
}

/* The member of a number; NULL with an error set if there is none. */
static Member *member_argument(Relay *relay, PyObject *number) {
    const long place = PyLong_AsLong(number);
    if (place == -1 && PyErr_Occurred()) return NULL;
    if (!relay->closed && place >= 0 && place < MEMBERS_MAX && relay->members[place].fd >= 0) return &relay->members[place];
    PyErr_Format(PyExc_IndexError, "no member %ld", place);
    return NULL;
}

PyDoc_STRVAR(take_doc,
"take($self, number, /)\n--\n\n"
"Write to a member no more.\n\n"
"Returns:\n"
"    The descriptor of its pipe, which is the caller's now, the bytes that are to be written there first, and\n"
"    whether it is late.\n");

static PyObject *relay_take(Relay *relay, PyObject *number) {
    Member *member = member_argument(relay, number);
    if (member == NULL) return NULL;
    PyObject *taken = NULL;
    pthread_mutex_lock(&relay->lock);
    const int late = member->detached;
    if (detach(relay, member)) {
        taken = Py_BuildValue(
            "iy#N", member->fd, member->rest, (Py_ssize_t)member->rest_size, PyBool_FromLong(late));
        if (taken != NULL) forget(member);
    } else {
        PyErr_NoMemory();
    }
    pthread_mutex_unlock(&relay->lock);
    return taken;
}

static PyObject *relay_in_the_way(Relay *relay, PyObject *frame) {
    if (frame_argument(&frame, 1) == NULL) return NULL;
    int numbers[MEMBERS_MAX], count = 0;
    pthread_mutex_lock(&relay->lock);
    for (int place = 0; place < relay->used; ++place) {
        const Member *member = &relay->members[place];
        if (member->strict && is_in_the_way(relay, member, (size_t)PyBytes_GET_SIZE(frame))) numbers[count++] = place;
    }
    pthread_mutex_unlock(&relay->lock);
    PyObject *list = PyList_New(count);
    for (int index = 0; list != NULL && index < count; ++index) {
        PyObject *number = PyLong_FromLong(numbers[index]);
        if (number == NULL) Py_CLEAR(list);
        else PyList_SET_ITEM(list, index, number);
    }
    return list;
}

PyDoc_STRVAR(give_up_doc,
"give_up($self, frame, number, /)\n--\n\n"
"A member that has no room for a frame is late: it loses what comes, until half of what waits is written.");

static PyObject *relay_give_up(Relay *relay, PyObject *const *arguments, Py_ssize_t count) {
    if (!arguments_are(count, 2) || frame_argument(arguments, 1) == NULL) return NULL;
    Member *member = member_argument(relay, arguments[1]);
    if (member == NULL) return NULL;
    pthread_mutex_lock(&relay->lock);
    const int slow = is_in_the_way(relay, member, (size_t)PyBytes_GET_SIZE(arguments[0]));
    const int done = !slow || detach(relay, member);
    pthread_mutex_unlock(&relay->lock);
    return done ? Py_NewRef(Py_None) : PyErr_NoMemory();
}

static PyObject *relay_remove(Relay *relay, PyObject *number) {
    Member *member = member_argument(relay, number);
    if (member == NULL) return NULL;
    pthread_mutex_lock(&relay->lock);
    while (member->writing) pthread_cond_wait(&relay->written, &relay->lock);
    close(member->fd);
    forget(member);
    pthread_mutex_unlock(&relay->lock);
    Py_RETURN_NONE;
}

static PyObject *relay_is_idle(Relay *relay, PyObject *unused) {
    (void)unused;
    int idle = 1;
    if (relay->closed) Py_RETURN_TRUE;
    pthread_mutex_lock(&relay->lock);
    for (int place = 0; place < relay->used; ++place) idle &= !is_behind(relay, &relay->members[place]);
    pthread_mutex_unlock(&relay->lock);
    return PyBool_FromLong(idle);
}

/* End the thread; in a forked child there is none, and nobody knows who holds the lock, or what it was freeing. */
static void stop(Relay *relay) {
    const int ours = relay->owner == getpid();
    if (relay->started && ours) {
        pthread_mutex_lock(&relay->lock);
        relay->stopping = 1;
        wake(relay);
        pthread_mutex_unlock(&relay->lock);
        Py_BEGIN_ALLOW_THREADS
        pthread_join(relay->thread, NULL);
        Py_END_ALLOW_THREADS
    }
    for (int place = 0; place < MEMBERS_MAX; ++place) {
        if (relay->members[place].fd >= 0) close(relay->members[place].fd);
        if (ours) forget(&relay->members[place]);
    }
    if (relay->wake_read >= 0) close(relay->wake_read);
    if (relay->wake_write >= 0) close(relay->wake_write);
    relay->wake_read = relay->wake_write = -1;
    free(relay->ring);
    relay->ring = NULL;
}

static PyObject *relay_close(Relay *relay, PyObject *unused) {
    (void)unused;
    if (!relay->closed) {
        relay->closed = 1; /* first: `stop` lets other threads run */
        stop(relay);
    }
    Py_RETURN_NONE;
}

static int open_wake(Relay *relay) {
    int fds[2];
#ifdef __linux__ /* at once, as another thread may start a program in between */
    if (pipe2(fds, O_NONBLOCK | O_CLOEXEC) < 0) return 0;
    relay->wake_read = fds[0];
    relay->wake_write = fds[1];
#else
    if (pipe(fds) < 0) return 0;
    relay->wake_read = fds[0];
    relay->wake_write = fds[1];
    for (int end = 0; end < 2; ++end) {
        if (fcntl(fds[end], F_SETFL, O_NONBLOCK) < 0 || fcntl(fds[end], F_SETFD, FD_CLOEXEC) < 0) return 0;
    }
#endif
    return 1;
}

/* Whoever holds the lock becomes as urgent as who waits for it, where the system can do that. */
static void make_lock(pthread_mutex_t *lock) {
    pthread_mutexattr_t attributes;
    pthread_mutexattr_init(&attributes);
    pthread_mutexattr_setprotocol(&attributes, PTHREAD_PRIO_INHERIT);
    if (pthread_mutex_init(lock, &attributes)) pthread_mutex_init(lock, NULL);
    pthread_mutexattr_destroy(&attributes);
}

static PyObject *relay_new(PyTypeObject *type, PyObject *arguments, PyObject *keywords) {
    static char *names[] = {"again", NULL};
    PyObject *again;
    if (!PyArg_ParseTupleAndKeywords(arguments, keywords, "O:Relay", names, &again)) return NULL;
    Relay *relay = (Relay *)type->tp_alloc(type, 0);
    if (relay == NULL) return NULL;
    relay->again = Py_NewRef(again);
    relay->owner = getpid();
    relay->wake_read = relay->wake_write = -1;
    for (int place = 0; place < MEMBERS_MAX; ++place) relay->members[place].fd = -1;
    make_lock(&relay->lock);
    pthread_cond_init(&relay->written, NULL);
    relay->capacity = RING_BYTES;
    relay->ring = malloc(RING_BYTES);
    if (relay->ring == NULL || !open_wake(relay) || !start(relay)) {
        if (relay->ring == NULL) PyErr_NoMemory();
        else PyErr_SetFromErrno(PyExc_OSError);
        Py_DECREF(relay);
        return NULL;
    }
    return (PyObject *)relay;
}

static void relay_dealloc(Relay *relay) {
    if (!relay->closed) stop(relay);
    if (relay->owner == getpid()) {
        pthread_mutex_destroy(&relay->lock);
        pthread_cond_destroy(&relay->written);
    }
    Py_DECREF(relay->again);
    Py_TYPE(relay)->tp_free((PyObject *)relay);
}

static PyMethodDef relay_methods[] = {
    {"send", (PyCFunction)(void (*)(void))relay_send, METH_FASTCALL, send_doc},
    {"offer", (PyCFunction)(void (*)(void))relay_offer, METH_FASTCALL, offer_doc},
    {"in_the_way", (PyCFunction)relay_in_the_way, METH_O, "Numbers of the reliable members that have no room for a frame."},
    {"give_up", (PyCFunction)(void (*)(void))relay_give_up, METH_FASTCALL, give_up_doc},
    {"add", (PyCFunction)relay_add, METH_VARARGS, add_doc},
    {"take", (PyCFunction)relay_take, METH_O, take_doc},
    {"remove", (PyCFunction)relay_remove, METH_O, "Write to a member no more, and close its pipe."},
    {"is_idle", (PyCFunction)relay_is_idle, METH_NOARGS, "Whether everything has been written."},
    {"close", (PyCFunction)relay_close, METH_NOARGS, "End the thread, and close the pipes."},
    {NULL, NULL, 0, NULL},
};

static PyTypeObject RelayType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.Relay",
    .tp_doc = "Relay(again)\n--\n\n"
              "A thread that writes a publisher's frames into the pipes of its readers.\n\n"
              "Args:\n"
              "    again: Raised where a reliable reader has no room.\n",
    .tp_basicsize = sizeof(Relay),
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_new = relay_new,
    .tp_dealloc = (destructor)relay_dealloc,
    .tp_methods = relay_methods,
};

int add_relay(PyObject *module) {
    if (PyType_Ready(&RelayType) < 0) return -1;
    return PyModule_AddObjectRef(module, "Relay", (PyObject *)&RelayType);
}
