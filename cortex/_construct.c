/* Making a message: what the `__init__` of its frozen dataclass does, without `object.__setattr__` for each field.

   A class that `hasten` was called for is called through `construct`: it allocates the object and puts the arguments
   into its slots. Whatever is not as usual (a value is missing, an argument is unknown or given twice, `__init__` or
   `__new__` was replaced since) it leaves to the class's own `__init__`, which also knows what to say about it. A
   subclass has its own `tp_vectorcall`, and so is not concerned. */

#include "_native.h"

#include <structmember.h>

enum { ARGUMENTS_MAX = 64 };

typedef struct {
    PyObject_VAR_HEAD
    PyObject *init;   /* the `__init__` that this does the work of */
    PyObject *names;  /* of the arguments, interned */
    PyObject *values; /* what stands for one that is left out */
    PyObject *required; /* among those: it may not be */
    Py_ssize_t slots[];
} Maker;

static PyObject *maker_name, *init_name, *type_call; /* the last is `type.__call__` */
static PyTypeObject MakerType;

/* Where objects of a class keep a field that is one of its slots; -1 with an error set if it is none. */
static Py_ssize_t slot_of(PyTypeObject *cls, PyObject *name) {
    PyObject *descriptor = PyObject_GetAttr((PyObject *)cls, name);
    if (descriptor == NULL) return -1;
    Py_ssize_t slot = -1;
    if (Py_IS_TYPE(descriptor, &PyMemberDescr_Type)
        && ((PyMemberDescrObject *)descriptor)->d_member->type == T_OBJECT_EX) {
        slot = ((PyMemberDescrObject *)descriptor)->d_member->offset;
    } else {
        PyErr_Format(PyExc_TypeError, "%s.%U is no slot", cls->tp_name, name);
    }
    Py_DECREF(descriptor);
    return slot;
}

/* The maker of a class if it still does what its `__init__` does, else NULL, with no error set; borrowed. */
static const Maker *maker_of(PyTypeObject *cls) {
    PyObject *maker = PyDict_GetItemWithError(cls->tp_dict, maker_name);
    PyObject *init = PyDict_GetItemWithError(cls->tp_dict, init_name);
    if (maker == NULL || !Py_IS_TYPE(maker, &MakerType) || init != ((Maker *)maker)->init
        || cls->tp_new != PyBaseObject_Type.tp_new) {
        PyErr_Clear();
        return NULL;
    }
    return (const Maker *)maker;
}

/* Put each value where its argument belongs; 0 if they do not fit. Values are borrowed. */
static int match(
    const Maker *maker, PyObject *const *given, Py_ssize_t positional, PyObject *keywords, PyObject **values) {
    const Py_ssize_t count = Py_SIZE(maker);
    PyObject *const *names = &PyTuple_GET_ITEM(maker->names, 0);
    if (positional > count) return 0;
    for (Py_ssize_t index = 0; index < positional; ++index) values[index] = given[index];
    for (Py_ssize_t index = positional; index < count; ++index) values[index] = NULL;
    const Py_ssize_t named = keywords == NULL ? 0 : PyTuple_GET_SIZE(keywords);
    Py_ssize_t next = positional; /* most name them in order */
    for (Py_ssize_t number = 0; number < named; ++number) {
        PyObject *name = PyTuple_GET_ITEM(keywords, number);
        if (next >= count || names[next] != name) {
            for (next = 0; next < count && names[next] != name; ++next) continue;
        }
        if (next == count || values[next] != NULL) return 0;
        values[next++] = given[positional + number];
    }
    for (Py_ssize_t index = positional; index < count; ++index) {
        if (values[index] == NULL) values[index] = PyTuple_GET_ITEM(maker->values, index);
        if (values[index] == maker->required) return 0;
    }
    return 1;
}

/* As the class's own `tp_call`. */
static PyObject *call_slowly(PyTypeObject *cls, PyObject *const *given, Py_ssize_t positional, PyObject *keywords) {
    const Py_ssize_t count = positional + (keywords == NULL ? 0 : PyTuple_GET_SIZE(keywords));
    PyObject **arguments = PyMem_New(PyObject *, count + 1);
    if (arguments == NULL) return PyErr_NoMemory();
    arguments[0] = (PyObject *)cls;
    for (Py_ssize_t index = 0; index < count; ++index) arguments[index + 1] = given[index];
    PyObject *made = PyObject_Vectorcall(type_call, arguments, (size_t)positional + 1, keywords);
    PyMem_Free(arguments);
    return made;
}

static PyObject *construct(PyObject *self, PyObject *const *given, size_t flags, PyObject *keywords) {
    PyTypeObject *cls = (PyTypeObject *)self;
    const Py_ssize_t positional = PyVectorcall_NARGS(flags);
    PyObject *values[ARGUMENTS_MAX];
    const Maker *maker = maker_of(cls);
    if (maker == NULL || !match(maker, given, positional, keywords, values)) {
        return call_slowly(cls, given, positional, keywords);
    }
    PyObject *message = cls->tp_alloc(cls, 0);
    if (message == NULL) return NULL;
    for (Py_ssize_t index = 0; index < Py_SIZE(maker); ++index) {
        *(PyObject **)((char *)message + maker->slots[index]) = Py_NewRef(values[index]);
    }
    return message;
}

static int maker_traverse(Maker *maker, visitproc visit, void *arg) {
    Py_VISIT(maker->init);
    Py_VISIT(maker->values);
    return 0;
}

static void maker_dealloc(Maker *maker) {
    PyObject_GC_UnTrack(maker);
    Py_DECREF(maker->init);
    Py_DECREF(maker->names);
    Py_DECREF(maker->values);
    Py_DECREF(maker->required);
    PyObject_GC_Del(maker);
}

static PyTypeObject MakerType = {
    PyVarObject_HEAD_INIT(NULL, 0)
    .tp_name = "cortex._native.Maker",
    .tp_doc = "What `hasten` knows of a class.",
    .tp_basicsize = sizeof(Maker),
    .tp_itemsize = sizeof(Py_ssize_t),
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC | Py_TPFLAGS_DISALLOW_INSTANTIATION,
    .tp_traverse = (traverseproc)maker_traverse,
    .tp_dealloc = (destructor)maker_dealloc,
};

PyDoc_STRVAR(hasten_doc,
"hasten($module, cls, names, values, required, /)\n--\n\n"
"Let calls of a class fill its slots directly.\n\n"
"Args:\n"
"    cls: A class whose `__init__` puts each argument into the slot of its name, and does nothing else.\n"
"    names: The arguments in order, at most 64, interned.\n"
"    values: Their defaults.\n"
"    required: What stands there for an argument that has none.\n");

static PyObject *hasten(PyObject *module, PyObject *arguments) {
    (void)module;
    PyTypeObject *cls;
    PyObject *names, *values, *required;
    if (!PyArg_ParseTuple(arguments, "O!O!O!O", &PyType_Type, &cls, &PyTuple_Type, &names, &PyTuple_Type, &values, &required))
        return NULL;
    const Py_ssize_t count = PyTuple_GET_SIZE(names);
    /* from Python 3.12 on, types that are no heap types may have no `tp_dict` */
    const int is_plain = (cls->tp_flags & Py_TPFLAGS_HEAPTYPE) && Py_IS_TYPE(cls, &PyType_Type);
    PyObject *init = is_plain ? PyDict_GetItemWithError(cls->tp_dict, init_name) : NULL;
    if (count > ARGUMENTS_MAX || PyTuple_GET_SIZE(values) != count || init == NULL) {
        if (!PyErr_Occurred()) PyErr_Format(PyExc_TypeError, "%s cannot be hastened", cls->tp_name);
        return NULL;
    }
    Maker *maker = PyObject_GC_NewVar(Maker, &MakerType, count);
    if (maker == NULL) return NULL;
    maker->init = Py_NewRef(init);
    maker->names = Py_NewRef(names);
    maker->values = Py_NewRef(values);
    maker->required = Py_NewRef(required);
    PyObject_GC_Track(maker);
    int failed = 0;
    for (Py_ssize_t index = 0; !failed && index < count; ++index) {
        maker->slots[index] = slot_of(cls, PyTuple_GET_ITEM(names, index));
        failed = maker->slots[index] < 0;
    }
    failed = failed || PyObject_SetAttr((PyObject *)cls, maker_name, (PyObject *)maker) < 0;
    Py_DECREF(maker);
    if (failed) return NULL;
    cls->tp_vectorcall = construct;
    Py_RETURN_NONE;
}

static PyObject *find_slot(PyObject *module, PyObject *arguments) {
    (void)module;
    PyTypeObject *cls;
    PyObject *name;
    if (!PyArg_ParseTuple(arguments, "O!U:slot_of", &PyType_Type, &cls, &name)) return NULL;
    const Py_ssize_t slot = slot_of(cls, name);
    return slot < 0 ? NULL : PyLong_FromSsize_t(slot);
}

static PyMethodDef functions[] = {
    {"slot_of", find_slot, METH_VARARGS, "Where objects of a class keep a field that is one of its slots."},
    {"hasten", hasten, METH_VARARGS, hasten_doc},
    {NULL, NULL, 0, NULL},
};

int add_construct(PyObject *module) {
    maker_name = PyUnicode_InternFromString("__cortex_maker__");
    init_name = PyUnicode_InternFromString("__init__");
    type_call = PyObject_GetAttrString((PyObject *)&PyType_Type, "__call__");
    if (maker_name == NULL || init_name == NULL || type_call == NULL || PyType_Ready(&MakerType) < 0) return -1;
    return PyModule_AddFunctions(module, functions);
}
