/* The ring of a publisher, for `_gate.c`; see `_broadcast.c`. */

#ifndef CORTEX_NATIVE_BROADCAST_H
#define CORTEX_NATIVE_BROADCAST_H

#include "_native.h"

/* Send a frame as a call to the `send` of a `Broadcast` would, unless some reader is late: that, too, is CORTEX_FULL. Else
   CORTEX_WRITTEN, CORTEX_TOO_LARGE, or -1 if `send` is something else. */
int broadcast_put(PyObject *send, const char *frame, Py_ssize_t size);

#endif
