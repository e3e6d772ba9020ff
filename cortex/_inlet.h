/* The way of a message in, for `_arrival.c`; see `_inlet.c`. */

#ifndef CORTEX_INLET_H
#define CORTEX_INLET_H

#include "_native.h"

extern PyTypeObject InletType;

/* Take the next message of an `Inlet` without waiting, as long as others need not get a turn; 0 if there is none, and
   `message` is what stands for nothing. Else it may be NULL with an error set. */
int inlet_take_soon(PyObject *inlet, PyObject **message);

#endif
