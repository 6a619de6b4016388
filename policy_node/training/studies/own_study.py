"""Studies by name: those of the paper's requests, and somebody's own, `module:NAME`."""

from __future__ import annotations

from importlib import import_module

from msgs_spec.text import did_you_mean, one_line
from policy_node.policies.python_policy import is_python_name, working_directory_first
from policy_node.training.studies.research import STUDIES
from policy_node.training.studies.study import Study

# Studies that are not of one page under docs/research.
_OTHERS = ('paper', 'best')


def find_study(name: str) -> Study | None:
    """Returns a study, also from a module in the working directory.

    Args:
        name: One of `STUDIES`; `paper` or `best`, which are none of those; or `module:NAME`.

    Raises:
        ValueError: If there is none, or the module fails; one line says why.
    """
    if is_python_name(name):
        return _imported(name)
    if name not in (*_OTHERS, *STUDIES):
        allowed = ', '.join((*_OTHERS, *STUDIES))
        hint = did_you_mean(name, (*_OTHERS, *STUDIES))
        raise ValueError(f'{name[:80]!r} given; allowed: {allowed}, module:NAME{hint}')
    return STUDIES.get(name)


def _imported(name: str) -> Study:
    module, _, attribute = name.partition(':')
    try:
        with working_directory_first():
            study = getattr(import_module(module), attribute)
    except (Exception, SystemExit) as error:
        raise ValueError(f'{name}: {type(error).__name__}: {one_line(error)}') from None
    if not isinstance(study, Study):
        raise ValueError(f'{name} is a {type(study).__name__}; allowed: a Study')
    if study.name in (*_OTHERS, *STUDIES) or not study.name.isidentifier():
        raise ValueError(f'{name} is called {study.name!r}; allowed: a word that no other study is')
    if not study.settings or not study.arms:
        raise ValueError(f'{name} has no settings of a task, or no arms')
    return study
