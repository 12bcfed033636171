"""The whole runs of `make test`: real processes, one run for each fault, each command and each feature.

Rule: a fact of the operating system, of processes or of the network has one whole run here. Its variants, and whole runs of
facts that a faster test holds, run in `make test-all` only. A test is named by its file and its name, whatever its folder.
"""

from __future__ import annotations

FAULTS = {  # the rows of docs/explanation/faults.md, in their order
    "a local worker's process dies": "test_failure_table.py::test_a_killed_worker_of_a_local_run_is_restarted",
    "a worker elsewhere dies": "test_failure_table.py::test_training_goes_on_after_a_worker_is_killed",
    "its simulator survives": (
        "test_process_group.py::test_the_slots_of_a_killed_worker_stay_taken_until_its_simulator_is_gone[False]"
    ),
    "a worker loses its connection": "test_network_faults.py::test_no_worker_is_lost_when_connections_are_reset",
    "the machine has its limit of copies": "test_local_run.py::test_a_local_run_keeps_within_the_env_copies_of_its_machine",
    "the file of slots is locked": "test_failure_table.py::test_a_run_whose_file_of_slots_is_locked_ends_and_names_the_file",
    "a worker is silent": "test_failure_table.py::test_a_stopped_worker_joins_again_when_it_continues",
    "a worker cannot start": (
        "test_failure_table.py::test_a_local_run_whose_workers_cannot_start_ends_with_what_they_wrote"
    ),
    "no local worker is left": "test_failure_table.py::test_a_local_run_ends_at_once_when_its_last_worker_has_left",
    "no worker elsewhere is left": "test_failure_table.py::test_a_run_without_workers_saves_a_checkpoint_and_fails",
    "a worker is asked to leave": "test_failure_table.py::test_a_worker_delivers_its_rollout_after_sigterm",
    "the learner does not listen": "test_failure_table.py::test_a_slow_learner_loses_no_worker",
    "calls take long": "test_slow_environments.py::test_calls_that_take_longer_than_the_worker_timeout[local]",
    "status says which": (
        "test_slow_environments.py::test_status_names_the_lane_and_the_call_of_a_worker_that_hangs_and_for_how_long"
    ),
    "a call of the environment hangs": "test_failure_table.py::test_training_goes_on_after_an_environment_hung",
    "a call of a policy hangs": "test_hanging_policies.py::test_an_environment_that_hangs_beside_it_is_not_called_a_policy",
    "the environment raises once": "test_failure_table.py::test_training_goes_on_after_an_environment_raised",
    "it raises again and again": (
        "test_local_run.py::test_an_environment_that_raises_ends_the_run_with_its_own_traceback[workers]"
    ),
    "it returns NaN": "test_local_run.py::test_nan_ends_the_run_with_an_error_that_says_where[workers-NaNReward-reward]",
    "it ends its process": (
        "test_slow_environments.py::test_too_many_ends_of_the_process_end_the_run_and_name_the_code[local]"
    ),
    "a policy of the user's fails": "test_masked_runs.py::test_an_own_policy_that_takes_an_illegal_action_is_named",
    "a worker takes an evaluation and dies": (
        "test_beside_training.py::test_so_it_does_if_those_that_play_it_are_killed_again_and_again"
    ),
    "a link is cut": "test_network_faults.py::test_a_worker_joins_again_after_its_network_was_cut[4]",
    "a peer sends invalid data": "test_network_faults.py::test_training_goes_on_while_peers_send_invalid_data",
    "a key is missing": "test_keys_run.py::test_a_worker_without_a_token_says_why_it_cannot_join",
    "a key is revoked": ("test_keys_run.py::test_a_revoked_worker_leaves_with_the_reason_and_the_run_goes_on_without_it"),
    "Ctrl-C": "test_local_run.py::test_ctrl_c_drains_saves_and_says_how_to_resume[workers]",
    "the learner is killed": "test_failure_table.py::test_workers_join_a_resumed_learner_on_the_same_port",
    "the disk is full": "test_failure_table.py::test_training_goes_on_while_the_disk_is_full",
    "the disk is full at the end": "test_ends.py::test_a_disk_that_is_full_at_the_end_fails_the_run",
    "the disk of a dataset is full": (
        "test_local_run.py::test_a_dataset_for_which_there_is_no_space_costs_no_training[while it trains]"
    ),
    "an update fails": "test_ends.py::test_an_update_that_fails_in_the_middle_is_taken_back[loss]",
    "a callback raises": "test_callbacks.py::test_a_raise_in_each_method[on_update-UsersError]",
    "SIGTERM": "test_preemption.py::test_an_update_that_does_not_fit_is_taken_back",
    "SIGHUP": "test_standard_streams.py::test_sighup_ends_a_run_as_sigterm_does",
    "nohup": "test_standard_streams.py::test_a_run_under_nohup_does_not_end_with_its_terminal",
    "standard output is full": "test_standard_streams.py::test_a_full_disk_takes_neither_output_nor_errors[plain]",
    "the run folder is deleted": "test_ends.py::test_a_run_whose_folder_is_gone_continues_in_a_new_one[deleted]",
    "a file cannot be written": (
        "test_ends.py::test_a_part_of_the_folder_that_cannot_be_written_costs_warnings_and_then_the_run[metrics.jsonl]"
    ),
}
COMMANDS = {  # where no test of a fault or a feature runs the command
    "learner, worker": "test_local_run.py::test_learner_and_workers_train_as_separate_processes",
    "worker --stay": "test_stay.py::test_a_worker_serves_two_runs_of_other_environments_and_ends_with_sigterm",
    "worker without PyTorch": "test_thin_worker.py::test_workers_join_and_status_shows_the_run",
    "status": "test_local_run.py::test_status_asks_the_learner_that_train_started_by_its_run_folder",
    "plan": ("test_plan.py::test_the_command_measures_an_environment_that_waits_and_names_a_command_that_trains"),
    "launch": "test_launch_kubernetes.py::test_the_commands_of_the_manifest_train",
    "dashboard": "test_page_beside.py::test_its_address_is_said_and_it_shows_the_end_of_the_run[workers]",
    "evaluate": "test_evaluation.py::test_a_run_reports_the_same_evaluation_whatever_the_number_of_workers",
    "record elsewhere": (
        "test_play_elsewhere.py::test_a_dataset_of_workers_from_elsewhere_is_that_of_local_ones[tcp with keys-workers]"
    ),
}
FEATURES = {
    "the same bits": (
        "test_local_run.py::test_the_curve_does_not_depend_on_the_number_of_workers[CartPole-v1-settings0-places0]"
    ),
    "lag": "test_local_run.py::test_with_a_lag_a_lost_worker_leads_to_the_same_run_whoever_is_fast",
    "resume at lag 1": "test_preemption.py::test_at_a_lag_a_resumed_run_equals_one_that_went_on[impala]",
    "LSTM, resumed": "test_preemption.py::test_a_resumed_run_equals_one_that_went_on[ppo, lstm]",
    "DQN": "test_dqn_run.py::test_curve_and_replay_ratio_do_not_depend_on_the_number_of_workers[settings1]",
    "SAC": "test_continuous_runs.py::test_bits_and_replay_ratio_do_not_depend_on_the_number_of_workers[sac]",
    "XQC, resumed": "test_preemption.py::test_a_resumed_run_equals_one_that_went_on[xqc]",
    "seats": "test_seats.py::test_the_weights_do_not_depend_on_the_number_of_workers[RandomCrowd-settings2]",
    "self-play": (
        "test_self_play.py::test_weights_pool_and_ratings_do_not_depend_on_the_number_of_workers[RandomGame-settings0]"
    ),
    "mixed actions": "test_mixed_actions.py::test_they_are_if_a_worker_dies_and_its_lanes_are_brought_back",
    "masks": "test_masked_runs.py::test_a_run_trains_evaluates_and_plays_with_masks[InInfo-workers]",
    "prior": "test_prior_data.py::test_prior_data_changes_what_is_learned_and_the_number_of_workers_does_not",
    "record": "test_local_run.py::test_training_episodes_are_recorded_whole",
    "inference learner": "test_inference.py::test_the_weights_equal_those_of_inference_workers[ppo]",
    "evaluation beside training": (
        "test_beside_training.py::test_it_finds_what_it_finds_while_training_waits[settings0-1-2-kwargs0]"
    ),
    "critic_keys": "test_critic_keys.py::test_a_policy_is_saved_loaded_and_evaluated_without_them",
    "set_env_attr": "test_curriculum.py::test_an_attribute_takes_effect_with_the_next_weights",
    "TCP with keys": "test_keys_run.py::test_a_run_on_this_machine_over_encrypted_tcp_learns_the_same",
    "a hostile worker": "test_hostile_worker.py::test_a_hostile_worker_changes_no_bit_of_the_weights",
    "a learner without the simulator": (
        "test_describe.py::test_a_learner_without_the_simulator_trains_with_workers_that_have_it"
    ),
    "an environment of the user's script": (
        "test_own_environments.py::test_a_script_trains_resumes_evaluates_and_records_what_it_registers[script]"
    ),
    "run lock": ("test_run_lock.py::test_four_runs_that_start_in_the_same_second_all_end_with_a_folder_of_their_own"),
    "signals": "test_signals.py::test_a_signal_where_nothing_is_to_be_saved_ends_the_command_as_later[15]",
    "RolloutService": "test_rollout_service.py::test_a_killed_worker_is_replaced_and_no_batch_is_missing",
    "a learner of the user's": "test_torch_example.py::test_the_weights_are_those_of_the_built_in_ppo[few updates]",
    "vector environment": "test_vector_env_faults.py::test_a_worker_killed_between_steps_comes_back_truncated[shared]",
    "vector environment elsewhere": "test_vector_env_faults.py::test_workers_elsewhere_join_by_tcp_and_come_back",
    "its learner is killed": "test_vector_env_faults.py::test_no_process_outlives_the_learner[killed]",
}
WHOLE_RUNS = frozenset({*FAULTS.values(), *COMMANDS.values(), *FEATURES.values()})
