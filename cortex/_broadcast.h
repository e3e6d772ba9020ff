/* The ring of a publisher, for `_fast_send.c` and `_coder.c`; see `_broadcast.c`. */

#ifndef CORTEX_NATIVE_BROADCAST_H
#define CORTEX_NATIVE_BROADCAST_H

#include "_native.h"

/* Send a frame as a call to the `send` of a `Broadcast` would, unless some reader is lagging: that, too, is CORTEX_FULL. Else
   CORTEX_WRITTEN, CORTEX_TOO_LARGE, or -1 if `send` is something else. */
int broadcast_put(PyObject *send, const char *frame, Py_ssize_t size);

/* Whether `send` is that of a `Broadcast` that is open. */
int broadcast_is_open(PyObject *send);

/* Where a frame of so many bytes may be written for all readers, if `send` is that of a `Broadcast` that nobody is lagging in and
   that has room; else NULL. `broadcast_finish` sends it. */
char *broadcast_begin(PyObject *send, Py_ssize_t size);
void broadcast_finish(PyObject *send, Py_ssize_t size);

/* A new `Slot` of a `Broadcast`; NULL if none is free or they are too small, perhaps with an error set. */
PyObject *broadcast_acquire(PyObject *cast, Py_ssize_t size);

/* The memory of a `Slot` of a `Broadcast`, and its size; NULL if it cannot be sent there any more. */
char *slot_memory(PyObject *slot, PyObject *cast, Py_ssize_t *bytes);

int slot_number(PyObject *slot);

/* Send the header of what was written into such a slot; as `broadcast_put`. */
int broadcast_commit(PyObject *slot, const char *frame, int all_or_none);

/* What keeps the body of the frame that a `RingReader` has taken last, borrowed, and where it is; NULL if the frame names
   no slot. Who has made use of it says so, that it be kept no longer than that. */
PyObject *reader_body(PyObject *reader, const char **data, Py_ssize_t *size);
void reader_body_taken(PyObject *reader);

#endif
