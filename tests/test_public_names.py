"""The names of `jaxslam`: looked up when first used, and the same for type checkers."""

import ast
import importlib
import inspect
import subprocess
import sys

import jaxslam


def names_for_type_checkers():
    """Names that `if TYPE_CHECKING` of jaxslam/__init__.py imports, as in its table of names."""
    with open(jaxslam.__file__, encoding="utf-8") as file:
        (branch,) = (node for node in ast.parse(file.read()).body if isinstance(node, ast.If))
    return {
        alias.asname or alias.name: (node.module, alias.name)
        for node in branch.body
        for alias in node.names
    }


def test_every_name_is_found_and_known_to_type_checkers():
    declared = names_for_type_checkers()
    assert set(jaxslam.__all__) == set(declared) == set(jaxslam._PUBLIC)
    for name, (module, attribute) in declared.items():
        assert getattr(jaxslam, name) is getattr(importlib.import_module(module), attribute), name
    assert set(jaxslam.__all__) <= set(dir(jaxslam))


def functions(value):
    """A public function, or the public functions and properties written in a class."""
    if not inspect.isclass(value):
        return [inspect.unwrap(value)]
    members = {k: v for k, v in vars(value).items() if not k.startswith("_")}
    found = [getattr(v, "__func__", getattr(v, "fget", v)) for v in members.values()]
    found = [getattr(v, "func", v) for v in found]  # of a cached property
    return [f for f in found if inspect.isfunction(f) and f.__module__.startswith("jaxslam")]


def test_the_public_interface_is_annotated():
    public = [getattr(jaxslam, name) for name in jaxslam.__all__]
    values = [value for value in public if not inspect.ismodule(value)]
    values += [jaxslam.learn.fit, jaxslam.likelihood.log_likelihood, jaxslam.likelihood.score]
    values += [jaxslam.uncertainty.assess, jaxslam.uncertainty.improve]
    checked = [function for value in values for function in functions(value)]
    assert len(checked) > 40
    for function in checked:
        signature = inspect.signature(function)
        bare = {p.name for p in signature.parameters.values() if p.annotation is p.empty}
        assert bare <= {"self", "cls"}, function
        assert signature.return_annotation is not signature.empty, function


def test_star_import_and_import_without_jax():
    program = """if True:
        import sys
        import jaxslam
        assert "jax" not in sys.modules
        names = {}
        exec("from jaxslam import *", names)
        assert set(jaxslam.__all__) <= set(names)
        try:
            jaxslam.no_such_name
        except AttributeError as error:
            assert "no_such_name" in str(error)
        else:
            raise AssertionError
    """
    subprocess.run([sys.executable, "-c", program], check=True)
