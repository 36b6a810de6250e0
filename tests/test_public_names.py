"""The names of `jaxslam`: looked up when first used, and the same for type checkers."""

import ast
import importlib
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
