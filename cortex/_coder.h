/* Messages to bytes and back, for the files that send and receive them. */

#ifndef CORTEX_CODER_H
#define CORTEX_CODER_H

#include "_native.h"
#include "_numpy.h"
#include "cpp/include/cortex/body.h"

enum { DEFERRED_MAX = 16 };
static const Py_ssize_t BODY_LIMIT = (Py_ssize_t)1 << 32;

typedef struct {
    PyObject_HEAD
    PyObject *rows, *objects;  /* bytes and a tuple of what they name, which are kept */
    const CortexItem *items;   /* those rows: the first is the outermost message */
    Py_ssize_t stamp; /* row of the field that is the stamp, -1: none */
    int has_head;
    char head[HEAD_SIZE];
    PyObject *slots; /* a RingReader, which has the bodies that are in slots; NULL or None: they are not read here */
} Coder;

extern PyTypeObject CoderType;

/* An array that is still to be copied. */
typedef struct {
    PyObject *array; /* borrowed */
    const void *data;
    uint64_t start, size;
} Deferred;

/* One message while it is encoded. */
typedef struct {
    CortexWrite write;
    const char *place; /* where it goes, if arrays may lie there already; NULL: they do not */
    int64_t stamp_ns;
    int defers; /* whether large arrays are left to `copy_deferred` */
    int deferred_count;
    Deferred deferred[DEFERRED_MAX];
} Pack;

/* Size of a message's body; -1 without error if it is not as usual. */
Py_ssize_t measure_body(const Coder *coder, PyObject *message);

/* As `measure_body`, where arrays may lie already in the `room` bytes to which the body goes: -1, too, if one of them
   is not where it belongs. */
Py_ssize_t measure_in_place(const Coder *coder, PyObject *message, const char *place, Py_ssize_t room);

/* Write a body of the size that was measured; 0 without error if the message is not as usual. */
int write_body(const Coder *coder, PyObject *message, Pack *pack, char *out, Py_ssize_t size, int defers);

/* Copy what was deferred: this needs no GIL, but someone who keeps the arrays (`hold` 1) and lets them go (-1). */
void copy_deferred(const Pack *pack);
void hold_deferred(const Pack *pack, int hold);

/* Write a whole frame, whose body has the size that was measured; 0 without error if the message is not as usual. */
int write_frame(const Coder *coder, PyObject *message, char *out, Py_ssize_t size, uint64_t sequence, int64_t publish_ns);

/* The same as bytes; NULL without error if the message is not as usual. */
PyObject *make_frame(const Coder *coder, PyObject *message, Py_ssize_t size, uint64_t sequence, int64_t publish_ns);

/* The message of a body within `owner`, which its arrays keep; NULL without error if it is malformed. */
PyObject *read_body(const Coder *coder, PyObject *owner, const char *body, Py_ssize_t size);

/* The message of a frame if it is the expected one; NULL without error if it is something else. */
PyObject *read_expected(const Coder *coder, PyObject *frame, uint64_t expected, int64_t *publish_ns);

/* Add to a histogram, a list of counts by powers of two of a nanosecond; 0 with an error set. */
int note_latency(PyObject *latency, int64_t elapsed_ns);

#endif
