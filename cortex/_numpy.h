/* NumPy's C interface; `_native.c` imports it for all files. */

#ifndef CORTEX_NUMPY_H
#define CORTEX_NUMPY_H

#define PY_ARRAY_UNIQUE_SYMBOL cortex_numpy
#define NPY_NO_DEPRECATED_API NPY_1_19_API_VERSION
#define NPY_TARGET_VERSION NPY_1_19_API_VERSION
#ifndef CORTEX_IMPORTS_NUMPY
#define NO_IMPORT_ARRAY
#endif
#include <numpy/arrayobject.h>

#endif
