"""Exit codes, one line per error, Ctrl-C, closed pipes and progress of all commands."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys

import pytest

from node_runtime.command_line import (
    CommandError,
    CommandParser,
    UsageError,
    run_command,
    say,
    whole_number,
)
from support import script_environment

PRELUDE = 'import sys, time\nfrom node_runtime.command_line import *\n'


def run_script(body: str, **options: object) -> subprocess.Popen[str]:
    """Starts `run` of a script as the command `tool`."""
    lines = ''.join(f'    {line}\n' for line in body.splitlines())
    code = f'{PRELUDE}def run():\n{lines}sys.exit(run_command("tool", run))'
    pipes = {'stdout': subprocess.PIPE, 'stderr': subprocess.PIPE} | options
    return subprocess.Popen(
        [sys.executable, '-c', code], text=True, env=script_environment(), **pipes
    )


TIDY = 'try:\n    print("begun", flush=True)\n    time.sleep(60)\nfinally:\n    print("tidied")'


def fail(error: BaseException) -> int:
    raise error


@pytest.mark.parametrize(
    ('error', 'code'), [(CommandError('no\nluck \x1b[31m'), 1), (UsageError('no luck \x1b[31m'), 2)]
)
def test_an_error_is_one_line_without_control_characters(error, code, capsys):
    assert run_command('tool', lambda: fail(error)) == code
    assert capsys.readouterr().err == 'tool: no luck \\x1b[31m\n'


def test_names_are_printed_with_escapes_and_other_errors_keep_their_traceback(capsys):
    say('runs/\udcff\x1b[31m done')
    assert capsys.readouterr().out == 'runs/\\udcff\\x1b[31m done\n'
    with pytest.raises(ZeroDivisionError):
        run_command('tool', lambda: 1 // 0)


@pytest.mark.parametrize(
    ('numbers', 'code', 'in_the_background'),
    [
        ([signal.SIGINT], 130, False),
        ([signal.SIGTERM], 143, False),
        ([signal.SIGHUP], 129, False),
        # Shells let commands in the background ignore Ctrl-C.
        ([signal.SIGINT, signal.SIGTERM], 143, True),
    ],
)
def test_a_signal_is_acknowledged_and_ends_with_its_code(numbers, code, in_the_background):
    handler = signal.SIG_IGN if in_the_background else signal.SIG_DFL
    process = run_script(TIDY, preexec_fn=lambda: signal.signal(signal.SIGINT, handler))
    assert process.stdout.readline() == 'begun\n'
    for number in numbers:
        process.send_signal(number)
    assert process.communicate(timeout=20) == ('tidied\n', 'tool: stopping\n')
    assert process.returncode == code


def test_a_second_ctrl_c_ends_a_command_that_tidies_for_ever():
    process = run_script(
        'try:\n    print(1, flush=True)\n    time.sleep(60)\nfinally:\n    time.sleep(60)'
    )
    process.stdout.readline()
    process.send_signal(signal.SIGINT)
    assert process.stderr.readline() == 'tool: stopping\n'
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=20) == ('', '')
    assert process.returncode == -signal.SIGINT


def test_other_handlers_of_signals_stay():
    before = signal.getsignal(signal.SIGINT)
    seen: list[int] = []
    signal.signal(signal.SIGINT, lambda number, frame: seen.append(number))
    try:
        assert run_command('tool', lambda: os.kill(os.getpid(), signal.SIGINT) or 0) == 0
        assert seen == [signal.SIGINT]
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    'act', ['print("line", flush=True)', 'print("line")', 'show_table("line")']
)
def test_a_closed_output_ends_quietly(act):
    imports = 'from node_runtime.command_line import show_table\n'
    process = run_script(f'{imports}for _ in range(100000): {act}\nreturn 0')
    process.stdout.readline()
    process.stdout.close()
    assert process.stderr.read() == ''
    assert process.wait(20) == 141


def test_a_full_output_is_one_line():
    with open('/dev/full', 'w') as full:
        process = run_script('print("line")\nreturn 0', stdout=full)
    assert process.stderr.read() == 'tool: cannot write: No space left on device\n'
    assert process.wait(20) == 1


@pytest.mark.parametrize(
    'words',
    [
        ['fetch_hand_sim', '--print-completion', 'bash'],
        ['fetch_hand_sim', 'episodes', 'list', '--help'],
        ['fetch_hand_sim.sim_node', '--help'],
    ],
)
def test_help_on_a_full_or_closed_output_ends_as_every_command(words):
    command = [sys.executable, '-m', *words]
    for output, code, said in (('/dev/full', 1, 'cannot write: No space'), (None, 141, '')):
        reader, writer = os.pipe() if output is None else (None, os.open(output, os.O_WRONLY))
        if reader is not None:
            os.close(reader)
        process = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True)
        os.close(writer)
        assert process.returncode == code
        assert said in process.stderr and process.stderr.count('\n') == bool(said)


@pytest.mark.parametrize('interrupt', [signal.SIG_DFL, signal.SIG_IGN])
@pytest.mark.parametrize('closed', [1, 2])
def test_a_command_without_stdout_or_stderr_does_its_work(closed, interrupt, tmp_path):
    def prepare():
        os.close(closed)
        signal.signal(signal.SIGINT, interrupt)

    body = f'with progress("x", 1): print(1); print(2, file=sys.stderr)\nopen("{tmp_path}/x", "w")'
    process = run_script(f'{body}\nreturn 3', preexec_fn=prepare)
    process.communicate(timeout=20)
    assert process.returncode == 3 and (tmp_path / 'x').exists()


def test_letters_that_the_output_does_not_have_are_escaped(monkeypatch):
    monkeypatch.setenv('PYTHONIOENCODING', 'latin-1')
    process = run_script('print("日本")\nraise UsageError("ж")')
    assert process.communicate(timeout=20) == ('\\u65e5\\u672c\n', 'tool: \\u0436\n')


def test_a_closed_terminal_ends_only_the_progress_bar():
    terminal, its_other_end = pty.openpty()
    body = (
        'with progress("things", 2) as advance:\n'
        '    print("begun", flush=True)\n'
        '    sys.stdin.readline()\n'
        '    advance(2)\n'
        'say("done")\n'
        'return 0'
    )
    process = run_script(body, stdin=subprocess.PIPE, stderr=its_other_end)
    os.close(its_other_end)
    assert process.stdout.readline() == 'begun\n'
    os.close(terminal)
    assert process.communicate('\n', timeout=20)[0] == 'done\n'
    assert process.returncode == 0


# Progress


def test_progress_is_shown_on_a_terminal_only():
    script = (
        'with progress("episodes", 3) as advance:\n    advance(1)\n    time.sleep(0.3)\nreturn 0'
    )
    terminal, end = pty.openpty()
    process, redirected = run_script(script, stderr=end), run_script(script)
    os.close(end)
    assert redirected.communicate(timeout=20) == ('', '')
    shown = b''
    try:
        while chunk := os.read(terminal, 4096):
            shown += chunk
    except OSError:
        pass  # Linux reports a closed other end so.
    finally:
        os.close(terminal)
    assert process.communicate(timeout=20)[0] == ''
    assert b'episodes' in shown and b'1/3' in shown


@pytest.mark.parametrize('text', ['0', '7', '', 'inf', '1.5', '-1', str(2**63), '\x1b[31m'])
def test_numbers_out_of_range_are_one_line(text, capsys):
    parser = CommandParser(prog='tool')
    parser.add_argument('--count', type=whole_number(1, 6))
    with pytest.raises(SystemExit) as caught:
        parser.parse_args([f'--count={text}'])
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert error == f'tool: argument --count: {text!r} given; allowed: whole numbers 1 ... 6\n'
    assert parser.parse_args(['--count', '6']).count == 6


def test_a_misspelt_choice_gets_a_suggestion(capsys):
    parser = CommandParser(prog='tool')
    parser.add_argument('-t', '--task', nargs='+', choices=['FetchPush', 'HandReach'])
    parser.add_argument('--count', type=int, choices=[1, 2])
    for given, hint in (('fetchpsh', "; did you mean 'FetchPush'?"), ('zzz', ')')):
        with pytest.raises(SystemExit):
            parser.parse_args(['--task', 'HandReach', given])
        error = capsys.readouterr().err
        assert error.endswith(f'{hint}\n') and error.count('\n') == 1
    with pytest.raises(SystemExit):
        parser.parse_args(['--count', '3'])
    assert 'invalid choice: 3' in capsys.readouterr().err
