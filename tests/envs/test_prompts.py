"""Prompts and verifiers: what tasks ask and what answers are worth, held-out prompts, wrong rewards in one line."""

from random import Random

import pytest
import torch

from pgkit import envs
from pgkit.envs.prompt_tasks import Addition, Countdown, Sorting, numbers, target, value
from pgkit.errors import UserError
from pgkit.seams import Simulator

OWN = {"prompt_length": 8, "completion_length": 4}


@pytest.mark.parametrize("task", [Addition(), Sorting(), Countdown()])
def test_a_task_verifies_its_own_solutions_and_fits_its_lengths(task):
    random = Random(0)
    prompts = [task.prompt(random) for _ in range(300)]
    for prompt in prompts:
        solution, taught = task.solution(prompt), task.teacher(prompt, random)
        assert task.rewards["correct"](prompt, solution) == 1
        assert task.rewards["correct"](prompt, solution + "9") == task.rewards["correct"](prompt, "") == 0
        assert len(prompt) <= task.prompt_length and max(len(solution), len(taught)) < task.completion_length
        assert set(prompt + solution + taught) <= set(task.alphabet)


def test_answers_by_hand():
    assert Addition().solution("58+67=") == "521"
    assert Sorting().solution("3917=") == "1379"
    assert Countdown().rewards["correct"]("2 5 7:17=", "5*2+7") == 1
    format = Countdown().rewards["format"]
    assert format("2 5 7:17=", "5+2+7") == 0.1 and format("2 5 7:17=", "5+7") == format("2 5 7:17=", "5+") == 0
    assert value("8*(3-5)", [3, 5, 8]) == -16 and value("8/4+5", [4, 5, 8]) == 7
    assert value("2**3", [2, 3]) is None and value("abs(2)", [2]) is None
    assert numbers("2 5 7:17=") == [2, 5, 7] and target("2 5 7:17=") == 17


class Always(Random):
    """Draws one number."""

    def __init__(self, number):
        super().__init__(0)
        self.number = number

    def random(self):
        return self.number


def test_the_addition_teacher_drops_carries_in_three_of_four():
    assert Addition().teacher("58+67=", Always(0.24)) == "521" and Addition().teacher("58+67=", Always(0.26)) == "51"
    random, task = Random(0), Addition()
    prompts = [task.prompt(random) for _ in range(10_000)]
    right = sum(task.teacher(p, random) == task.solution(p) for p in prompts) / 10_000
    # tens are 1 to 9, or 0 to 9 below hundreds: a quarter .55 * 36/81, a half .55 * .5, a quarter .55 * .55 * 36/81
    without_carry = 0.25 * 0.55 * 36 / 81 + 0.5 * 0.55 * 0.5 + 0.25 * 0.55 * 0.55 * 36 / 81
    assert right == pytest.approx(0.25 + 0.75 * without_carry, abs=0.015)


def test_prompts_are_padded_on_the_left_and_completions_on_the_right():
    env = envs.prompts("addition", 2)
    digits = {c: i for i, c in enumerate("0123456789+=", 2)}
    row = env.encode(["58+67="])[0].tolist()
    assert row == [-1, -1, *(digits[c] for c in "58+67=")]
    answers = env.completions(["521", "1234567"])
    assert answers.tolist() == [[7, 4, 3, 1, 0], [3, 4, 5, 6, 7]]
    assert env.decode(answers) == ["521", "12345"]
    assert env.decode(torch.tensor([[7, 1, 7, 7, 7]])) == ["5"]  # what follows a stop token is nothing
    assert env.verify(["58+67=", "1+1="], torch.tensor([[7, 4, 3, 1, 0], [7, 4, 3, 1, 0]]))["correct"].tolist() == [
        1,
        0,
    ]


def test_held_out_prompts_are_never_drawn_for_training():
    train, held_out = envs.prompts("sorting", 3000, seed=1), envs.prompts("sorting", 3000, seed=2, held_out=True)
    train.reset()
    held_out.reset()
    assert not set(train.texts) & set(held_out.texts)
    with pytest.raises(UserError, match="too few prompts to hold a tenth of them out"):
        envs.prompts(lambda random: "1+1=", 1, reward=lambda p, c: 0, held_out=True, **OWN).reset()


def test_it_is_a_simulator_of_one_step():
    env = envs.prompts("addition", 3, seed=4)
    assert isinstance(env, Simulator)
    entries = env.reset()
    texts = list(env.texts)
    assert env.observation_spec["observation"].is_in(entries["observation"])
    action = env.completions([Addition().solution(texts[0]), "1", "2"])
    assert env.action_spec["action"].is_in(action)
    step = env.step({"action": action})
    assert step.reward["reward"].tolist() == [[1], [0], [0]] and step.terminated["terminated"].all()
    assert torch.equal(step.next["observation"], entries["observation"])
    assert torch.equal(step.fresh["observation"], env.encode(env.texts)) and env.texts != texts
    assert env.episode_reward["reward"].flatten().tolist() == [1, 0, 0] and env.step_count.tolist() == [1, 1, 1]


def test_some_rows_are_drawn_anew():
    env = envs.prompts("addition", 3, seed=4)
    env.reset()
    before = list(env.texts)
    env.reset(rows=torch.tensor([False, True, False]))
    assert [a == b for a, b in zip(before, env.texts, strict=True)] == [True, False, True]


def test_a_state_goes_on_where_it_was():
    env = envs.prompts("countdown", 4, seed=3)
    env.reset()
    state = env.state_dict()
    after = env.reset()["observation"]
    other = envs.prompts("countdown", 4, seed=9)
    assert torch.equal(other.load_state_dict(state)["observation"], env.encode(state["texts"]))
    assert torch.equal(other.reset()["observation"], after)
    assert torch.equal(env.reset(seed=3)["observation"], envs.prompts("countdown", 4, seed=3).reset()["observation"])


def test_rewards_of_one_s_own_add_up_by_name():
    env = envs.prompts(["ab", "cde"], 2, reward={"length": lambda p, c: len(c), "same": lambda p, c: p == c}, **OWN)
    scores = env.verify(["ab", "cde"], env.completions(["ab", "x"]))
    assert {name: x.tolist() for name, x in scores.items()} == {"length": [2, 1], "same": [1, 0]}
    env.reset()
    texts = list(env.texts)
    reward = env.step({"action": env.completions(texts)}).reward["reward"]
    assert reward.tolist() == [[1.0 + len(text)] for text in texts]
    one = envs.prompts(lambda random: f"{random.randint(0, 99)}", 2, reward=lambda p, c: 1.5, **OWN)
    one.reset()
    assert one.verify(one.texts, one.completions(["", ""]))["reward"].tolist() == [1.5, 1.5]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: envs.prompts("subtraction"), "no task 'subtraction': there are addition, sorting, countdown"),
        (lambda: envs.prompts(["a"]), "nothing says what a completion is worth: give reward="),
        (lambda: envs.prompts([], reward=len), "the list of prompts is empty"),
        (lambda: envs.prompts(["a"], reward=len, completion_length=3), "prompts of your own need prompt_length="),
        (lambda: envs.prompts("addition", prompt_length=5).reset(), r"the prompt '.*' has \d tokens, prompt_length=5"),
        (lambda: envs.prompts(["aé"], 1, reward=len, **OWN).reset(), "'aé' has 'é', the tokenizer knows only"),
        (lambda: envs.prompts("addition", 0), "batch=0: give a whole number, at least 1"),
    ],
)
def test_mistakes_in_one_line(make, message):
    with pytest.raises(UserError, match=message) as error:
        make()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (float("nan"), r"the reward 'mine' of prompt 'ab' and completion 'ab' is nan: return a finite number"),
        (float("inf"), "is inf: return a finite number"),
        ([1.0, 0.0], r"is \[1.0, 0.0\]: return one number"),
        (torch.zeros(2), "is tensor.*: return one number"),
        (None, "is None: return one number"),
    ],
)
def test_rewards_that_are_no_number(reward, message):
    env = envs.prompts(["ab"], 1, reward={"mine": lambda p, c: reward}, **OWN)
    with pytest.raises(UserError, match=message):
        env.verify(["ab"], env.completions(["ab"]))


def test_a_task_of_reasoning_gym():
    env = envs.prompts("reasoning_gym/chain_sum", 5, seed=1)
    env.reset()
    answers = [
        str(eval(text.removeprefix("State the final answer to the following arithmetic problem: ").rstrip(" =")))
        for text in env.texts
    ]
    scores = env.verify(env.texts, env.completions([answers[0], *(f"{answer}1" for answer in answers[1:])]))["reward"]
    assert scores[0] == 1 and scores[1:].max() < 1
    with pytest.raises(UserError, match="reasoning_gym/nothing: "):
        envs.prompts("reasoning_gym/nothing")
