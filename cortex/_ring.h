/* Slots of a ring, for the short cuts of `_gate.c` and `_coder.c`; see `_ring.c`. */

#ifndef CORTEX_RING_H
#define CORTEX_RING_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <stdint.h>

/* Adds its types to the module; 0, or -1 with an error set. */
int add_ring(PyObject *module);

/* A `Ledger`, or NULL if the object is none. */
typedef struct Ledger Ledger;
Ledger *ledger_of(PyObject *object);

/* A slot to write a body of `size` bytes, or -1: none is free, or it is too small. */
Py_ssize_t ledger_acquire(Ledger *ledger, Py_ssize_t size);
char *ledger_memory(Ledger *ledger, Py_ssize_t slot);

/* Whether a slot of this number is being written, and how much there is room for. */
int ledger_is_writing(const Ledger *ledger, Py_ssize_t slot);
Py_ssize_t ledger_slot_bytes(const Ledger *ledger);

/* Whether all readers with a column have room for one more message. */
int ledger_has_room(Ledger *ledger);

/* Lease a written slot to all readers; the descriptor to send, or NULL with an error set, and nothing leased. */
PyObject *ledger_commit(
    Ledger *ledger, Py_ssize_t slot, uint64_t sequence, int64_t stamp_ns, int64_t publish_ns, Py_ssize_t size);
void ledger_abandon(Ledger *ledger, Py_ssize_t slot);

/* Keep the memory while it is copied into without the GIL (`more` 1), and let it go (-1). */
void ledger_use(Ledger *ledger, int more);

/* What keeps the message that a descriptor names, and where its body is; NULL without error if it is not as usual.
   `cancel_lease` takes it back: as if it had not been looked at. */
PyObject *take_lease(PyObject *view, const char *descriptor, const char **body, Py_ssize_t *size);
void cancel_lease(PyObject *lease);

#endif
