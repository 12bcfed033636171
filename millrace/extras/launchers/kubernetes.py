"""`millrace launch kubernetes`: makes a manifest with a learner and workers. Pure, except that it reads a key folder.

The learner is a Job, which ends with the run. If its pod is lost, another pod resumes the run from the newest checkpoint.
The workers are a Deployment, which can be resized at any time and stays for the next learner. The manifest contains secrets
only if the user named a key folder.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from datetime import datetime

from millrace.extras.launchers.command_line import METRICS_PORT, learner_flags
from millrace.extras.launchers.flags import KubernetesFlags
from millrace.protocol.errors import UsageError
from millrace.protocol.home_folder import expanded
from millrace.protocol.keys.key_folder import FIRST_CLIENT, KeyFolder

PORT = 5555
TOKEN = f"{FIRST_CLIENT}.token"


def manifest(flags: KubernetesFlags, rest: Sequence[str], now: datetime) -> str:
    """The manifest, as YAML documents. `rest`: the user's flags for the learner.

    Raises `UsageError` if a flag or the key folder can't be used.
    """
    keys = [_secret(flags.name, KeyFolder(expanded(flags.keys, "key folder")), now)] if flags.keys else []
    parts = [*keys, _service(flags), _storage(flags), _learner(flags, rest), _workers(flags), _budget(flags)]
    return _comments(flags) + "---\n" + "---\n".join(parts)


def _comments(flags: KubernetesFlags) -> str:
    secret = f"kubectl create secret generic {flags.name}-keys --from-file=KEYS"
    lines = [
        f"A learner and {flags.workers} workers. See docs/how-to/clusters.md.",
        *(["This file holds keys: keep it secret."] if flags.keys else ["millrace keys new default --keys KEYS", secret]),
        "kubectl apply -f THIS_FILE",
        f"kubectl logs -f job/{flags.name}-learner",
        f"kubectl scale deployment/{flags.name}-worker --replicas=8",
    ]
    return "".join(f"# {line}\n" for line in lines)


def _secret(name: str, folder: KeyFolder, now: datetime) -> str:
    folder.server()
    folder.ensure_first_client(now)
    if not folder.token_path(FIRST_CLIENT).is_file():
        raise UsageError(
            f"key folder {folder.path}: expected {TOKEN}, the token of the workers; `millrace keys new {FIRST_CLIENT} "
            f"--keys {folder.path}` makes it"
        )
    files = [folder.path / "server.key", folder.list_path, folder.token_path(FIRST_CLIENT)]
    data = "".join(f"  {file.name}: {base64.b64encode(file.read_bytes()).decode()}\n" for file in files)
    return f"""\
apiVersion: v1
kind: Secret
metadata:
  name: {name}-keys
  labels: {{app.kubernetes.io/name: {name}}}
type: Opaque
data:
{data}"""


def _service(flags: KubernetesFlags) -> str:
    return f"""\
apiVersion: v1
kind: Service
metadata:
  name: {flags.name}
  labels: {{app.kubernetes.io/name: {flags.name}}}
spec:
  selector: {{app.kubernetes.io/name: {flags.name}, app.kubernetes.io/component: learner}}
  ports:
    - {{name: workers, port: {PORT}}}
    - {{name: metrics, port: {METRICS_PORT}}}
"""


def _storage(flags: KubernetesFlags) -> str:
    return f"""\
apiVersion: v1
kind: PersistentVolumeClaim
metadata:
  name: {flags.name}-runs
  labels: {{app.kubernetes.io/name: {flags.name}}}
spec:
  accessModes: [ReadWriteOnce]
  resources: {{requests: {{storage: {json.dumps(flags.storage)}}}}}
"""


def _learner(flags: KubernetesFlags, rest: Sequence[str]) -> str:
    own = learner_flags(flags.env, rest, flags.workers, bind=f"tcp://0.0.0.0:{PORT}", runs="/runs")
    args = ["learner", *own, "--advertise", flags.name, "--metrics-bind", f"0.0.0.0:{METRICS_PORT}"]
    image = json.dumps(flags.learner_image)
    status = json.dumps(["millrace", "status", f"tcp://127.0.0.1:{PORT}", "--json"])
    return f"""\
apiVersion: batch/v1
kind: Job
metadata:
  name: {flags.name}-learner
  labels: {{app.kubernetes.io/name: {flags.name}}}
spec:
  backoffLimit: 10
  podFailurePolicy:
    rules:
      - action: FailJob  # bad usage: it would fail again
        onExitCodes: {{containerName: learner, operator: In, values: [2]}}
      - action: Ignore  # the node was drained or preempted
        onPodConditions: [{{type: DisruptionTarget, status: "True"}}]
  template:
    metadata:
      labels: {{app.kubernetes.io/name: {flags.name}, app.kubernetes.io/component: learner}}
      annotations: {{prometheus.io/scrape: "true", prometheus.io/port: "{METRICS_PORT}"}}
    spec:
      restartPolicy: Never
      terminationGracePeriodSeconds: 60  # for the current update, a checkpoint, and the workers' last rollouts
{_pod()}
      initContainers:
        - name: keys  # the learner refuses keys that others can read, so it gets copies of its own
          image: {image}
          imagePullPolicy: IfNotPresent
          command: [sh, -c, "umask 077; mkdir -p /keys/own; cp /secret/* /keys/own"]
{_container(cpu="100m", memory="64Mi")}
          volumeMounts:
            - {{name: secret, mountPath: /secret, readOnly: true}}
            - {{name: keys, mountPath: /keys}}
      containers:
        - name: learner
          image: {image}
          imagePullPolicy: IfNotPresent
          args: {_args(args)}
          env:
            - {{name: MILLRACE_KEYS, value: /keys/own}}
            - {{name: MILLRACE_TOKEN, value: /keys/own/{TOKEN}}}  # the probes need a token, as every client does
          ports:
            - {{name: workers, containerPort: {PORT}}}
            - {{name: metrics, containerPort: {METRICS_PORT}}}
          startupProbe: {{exec: {{command: {status}}}, periodSeconds: 5, timeoutSeconds: 10, failureThreshold: 60}}
          readinessProbe: {{httpGet: {{path: /metrics, port: metrics}}, periodSeconds: 10}}
          livenessProbe: {{exec: {{command: {status}}}, periodSeconds: 60, timeoutSeconds: 20, failureThreshold: 3}}
{_container(flags.learner_cpu, flags.learner_memory)}
          volumeMounts:
            - {{name: runs, mountPath: /runs}}
            - {{name: keys, mountPath: /keys}}
            - {{name: tmp, mountPath: /tmp}}
      volumes:
        - {{name: runs, persistentVolumeClaim: {{claimName: {flags.name}-runs}}}}
        - {{name: secret, secret: {{secretName: {flags.name}-keys}}}}
        - {{name: keys, emptyDir: {{medium: Memory}}}}
        - {{name: tmp, emptyDir: {{}}}}
"""


def _workers(flags: KubernetesFlags) -> str:
    args = [f"tcp://{flags.name}:{PORT}", "--stay"]
    return f"""\
apiVersion: apps/v1
kind: Deployment
metadata:
  name: {flags.name}-worker
  labels: {{app.kubernetes.io/name: {flags.name}}}
spec:
  replicas: {flags.workers}
  selector:
    matchLabels: {{app.kubernetes.io/name: {flags.name}, app.kubernetes.io/component: worker}}
  template:
    metadata:
      labels: {{app.kubernetes.io/name: {flags.name}, app.kubernetes.io/component: worker}}
    spec:
      terminationGracePeriodSeconds: 30  # for the current rollout
{_pod()}
      containers:
        - name: worker  # no probe: its supervisor ends a worker whose step hangs; after a run it waits for the next learner
          image: {json.dumps(flags.worker_image)}
          imagePullPolicy: IfNotPresent
          command: [millrace, worker]  # also of an image that begins otherwise, such as the learner's, which has PyTorch
          args: {_args(args)}
          env:
            - name: MILLRACE_TOKEN  # as text: the files of a Secret can be read by the pod's group
              valueFrom: {{secretKeyRef: {{name: {flags.name}-keys, key: {TOKEN}}}}}
{_container(flags.worker_cpu, flags.worker_memory)}
          volumeMounts:
            - {{name: tmp, mountPath: /tmp}}
      volumes:
        - {{name: tmp, emptyDir: {{}}}}
"""


def _budget(flags: KubernetesFlags) -> str:
    return f"""\
apiVersion: policy/v1
kind: PodDisruptionBudget
metadata:
  name: {flags.name}-worker
  labels: {{app.kubernetes.io/name: {flags.name}}}
spec:
  maxUnavailable: 50%  # training continues with the others
  selector:
    matchLabels: {{app.kubernetes.io/name: {flags.name}, app.kubernetes.io/component: worker}}
"""


def _pod() -> str:
    """The security restrictions of every pod."""
    return """\
      automountServiceAccountToken: false
      enableServiceLinks: false
      securityContext:
        {runAsNonRoot: true, runAsUser: 1000, runAsGroup: 1000, fsGroup: 1000, seccompProfile: {type: RuntimeDefault}}"""


def _container(cpu: str, memory: str) -> str:
    """The resources and security restrictions of a container."""
    return f"""\
          resources:
            requests: {{cpu: {json.dumps(cpu)}, memory: {json.dumps(memory)}}}
            limits: {{memory: {json.dumps(memory)}}}
          securityContext:
            {{allowPrivilegeEscalation: false, readOnlyRootFilesystem: true, capabilities: {{drop: [ALL]}}}}"""


def _args(args: Sequence[str]) -> str:
    """A list of arguments in YAML. `$` is escaped: Kubernetes replaces `$(NAME)` with a variable, and `$$` with `$`."""
    return json.dumps([arg.replace("$", "$$") for arg in args])
