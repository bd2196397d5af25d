# SPDX-License-Identifier: Apache-2.0
"""What commands refuse: exit code 1, and a message that names the option, or the line and column of a file."""

import shlex

import pytest

SAMPLES = "t,joint1_position,joint1_torque,root_strain,middle_strain\n"
#: Files that the command lines name.
FILES = {
    "word.csv": "t,tau1,tau2\n0,0,0\n1,x,0\n",
    "nan.csv": "t,tau1,tau2\n0,0,0\n1,nan,0\n",
    "back.csv": "t,tau1,tau2\n0,0,0\n2,0,0\n\n1,0,0\n",
    "one_joint.csv": "t,tau1\n0,0\n",
    "ragged.csv": "t,tau1,tau2\n0,0\n",
    "no_rows.csv": "t,tau1,tau2\n",
    "empty.csv": "",
    "twice.csv": "t,q1\n0,0\n0,1\n1,1\n2,2\n3,3\n",
    "two_rows.csv": "t,q1\n0,0\n1,1\n",
    "short.csv": "t,q1\n0,0\n1,1\n2,0\n3,1\n",
    "one_sample.csv": SAMPLES + "0,0,0,0,0\n",
    "no_position.csv": "t,joint1_torque\n0,0\n",
    "text.csv": SAMPLES + "0,x,0,0,0\n",
    "no_torque.csv": SAMPLES + "".join(f"{0.01 * k},0,nan,0,0\n" for k in range(30)),
}
#: By how the command line begins: how it goes on, and the message.
REFUSED = {
    "simulate two_link": {
        "--initial 1": "--initial: 1 is the wrong number of angles (2)",
        "--initial a,b": "--initial: 'a,b' is no list of finite numbers",
        "--initial nan,1": "--initial: 'nan,1' is no list of finite numbers",
        "--step 0": "--step: 0.0 is out of range (finite, above 0)",
        "--rate nan": "--rate: nan is out of range",
        "--duration -1": "--duration: -1.0 is out of range",
        "--duration 1e9": "makes 100000000000 rows (10000000 rows)",
        "--modes 0": "modes of two_link: 0 is out of range (1 to 20)",
    },
    "simulate two_link --out o.csv --torque": {
        "none.csv": "none.csv",
        "word.csv": "word.csv:3: tau1: 'x' is not a number",
        "nan.csv": "nan.csv:3: tau1: nan is not finite",
        "back.csv": "back.csv:5: t = 1 comes after 2",
        "one_joint.csv": "one_joint.csv:1: columns are t,tau1, wanted t,tau1,tau2: one per joint (joint1, joint2)",
        "ragged.csv": "ragged.csv:2: 2 values for 3 columns",
        "no_rows.csv": "no_rows.csv: no rows",
        "empty.csv": "empty.csv: empty; its first line must be t,tau1,tau2",
    },
    "simulate one_link --prescribed": {
        "twice.csv": "t = 0 is there twice; joints can't jump",
        "two_rows.csv": "2 rows; at least 4",
        "short.csv --duration 4": "is longer than the motion",
        "short.csv --initial 1": "starts where its table does",
        "short.csv --method implicit": "--method: 'implicit' can't prescribe a motion (dop853, rk4)",
    },
    "simulate": {
        "R --foreshortening": "model: 'paper_appendix' of R supports neither foreshortening",
        "R --level stiffening": "model: 'paper_appendix' of R supports neither foreshortening",
        "two_link --level first_order --finite-slope": "--level: 'first_order' contradicts --finite-slope",
        "R --payload-scale 2": "--payload-scale: is possible only with --trajectory",
        "R --noise": "--noise: is possible only with --trajectory",
        "R --set slow.kp=1": "--set: is possible only with --trajectory",
        "R --controller paper_composite": "--trajectory: is missing",
        "R --trajectory paper --modes 3": "--modes: is not possible with --trajectory",
        "two_link --trajectory paper --set slow.kp=1": "slow.kp: no such parameter of 'joint_pid'",
        "nothing": "'nothing' is neither a file nor a shipped arm",
    },
    "simulate R --trajectory paper --controller": {
        "nowhere": "neither a file nor shipped",
        "paper_composite --torque x.csv": "--torque: is not possible with --controller",
        "paper_composite --modes 3": "--modes: is not possible with --controller",
        "paper_composite --foreshortening": "--foreshortening: is not possible with --controller",
        "paper_composite --payload-scale -1": "payload of R: -1.0 is out of range",
        "paper_composite --plant-modes 99": "plant_modes: 99 is above",
    },
    "simulate R --trajectory paper --controller paper_composite --set": {
        "slow.kpp=1.0": "slow.kpp: no such parameter of 'linear_model_following'; there are slow.type, slow.kp, slow",
        "slow.type=sliding": "'sliding' is provided by no installed package",
        "observer.alpha=1": "observer.alpha: no such parameter of 'filtered_derivative'",
        "slow.kp=6.0 torque_limt=1": "; did you mean torque_limit?",
        "arm=P3": "arm: no such parameter",
        "slow.kp": "'slow.kp' is no setting; write name=value",
        "slow.kp=[1.0": "slow.kp: '[1.0' is not YAML",
        "slow.type=3": "slow.type: 3 is not a name",
        "slow.kp=[6]": "slow.kp: [6] is a list of integers where floats are needed; write [6.0]",
        "slow.kp=1,2": "slow.kp: 2 values where 1 (joints) are needed; one value stands for all",
        "fast.alpha=-1": "fast.alpha: -1.0 1/s is below its lower limit",
        "rate=0.5": "rate: 0.5 Hz is below its lower limit (1.0)",
        "torque_limit=much": "torque_limit: 'much' is not a list of numbers",
    },
    "analyze R paper_composite --quick": {
        "--configurations 0": "--configurations: 0 is too small",
        "--seed -1": "--seed: -1 is too small",
        "--workers 2": "only with --monte-carlo",
        "--trajectory nothing": "nothing",
    },
    "gauges": {
        "rigid": "modes to observe: of rigid are none",
        "R --count 1": "--count: 1 gauges can't observe the 2 modes of link1 in y",
        "R --count 22": "--count: 22 gauges are more than there are positions (21)",
        "R --modes 0": "modes of R: 0 is out of range (1 to 20)",
        "nothing": "neither a file nor a shipped arm",
        "R --plot gauges.txt": "--plot: 'gauges.txt' has the wrong suffix (.png, .svg, .pdf)",
    },
    "observers R --duration 0.1": {
        "--rates 0": "--rates: 0.0 is out of range",
        "--delays 1.0": "--delays: 1.0 is out of range",
        "--rates fast": "--rates: 'fast' is no list of finite numbers",
        "--duration 1e9": "samples of 1e+09 s at 1000 Hz: 1000000000000.0 is out of range",
        "--observers unknown_name": "unknown_name",
    },
    "robustness R --seeds": {
        "0": "--seeds: 0 is out of range (1 to 1000)",
        "1 --loss 0.5:0.1:0.2": "--loss: '0.5:0.1:0.2' is no possible range (0 to 1, at most 200 levels)",
    },
    "compare": {
        "--arms P9": "--arms: 'P9' is unknown (R, ",
        "--controllers 'joint PID,other'": "--controllers: 'other' is unknown",
        "--budget 0": "--budget: 0 is too small (1 or more)",
        "--workers 0": "--workers: 0 is too small (1 or more)",
    },
    "excite one_link": {
        "--out bag": "stand clear, and give --allow-motion",
        "--allow-motion --out .": "exists already",
    },
    "identify": {
        "nothing.csv one_link": "no such file or bag",
        "one_link": "either a bag or CSV file",
        "one_sample.csv one_link": "1 samples are no motion (at least 20",
        "no_position.csv one_link": "no column joint1_position (wanted: t, joint1_position",
        "text.csv one_link": "text.csv:2: joint1_position: 'x' is not a number",
        "no_torque.csv one_link": "joint_position: does not change",
    },
}
LINES = {
    f"{begin} {rest}": text for begin, rests in REFUSED.items() for rest, text in rests.items()
}


@pytest.mark.parametrize("line", LINES)
def test_what_a_command_can_not_use_it_refuses(line, flexarm, tmp_path, monkeypatch):
    for name, content in FILES.items():
        (tmp_path / name).write_text(content)
    monkeypatch.chdir(tmp_path)
    code, _, err = flexarm(*shlex.split(line))
    assert code == 1
    assert LINES[line] in err
    assert not (tmp_path / "o.csv").exists()
