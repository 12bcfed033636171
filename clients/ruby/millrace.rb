# A millrace worker of the environment profile: the learner acts, this worker resets and steps.
# docs/how-to/write_a_client.md writes it step by step. Observations: a float32 Box. Actions: Discrete.
require "ffi-rzmq"
require "msgpack"
require "socket"

class Worker
  def initialize(address, environment, name)
    @address, @environment, @name, @give_up_at = address, environment, name, now + 600 # seconds
    @context, @lock, @lanes, @held, @steps = ZMQ::Context.new, Mutex.new, {}, [], 0
    @nonce = @attempt = rand(2**52)
    %w[TERM INT].each { |signal| trap(signal) { @stop = true } }
  end

  def run
    @lock.lock
    join
    Thread.new { loop { sleep 0.05; @lock.synchronize { beat if @session && now > @next_at } } }
    until @exit_code
      message = []
      take(*message) if @socket.recv_strings(message) != -1 # it waits for RCVTIMEO at most
      tick unless @exit_code
    end
    @socket.close
    @context.terminate # it waits until all is sent, for LINGER at most
    @exit_code
  end

  def join
    @session, @silence_s, @next_at, @pause_s = nil, 20, 0, 0.25
    @attempt, @heard_at = @attempt + 1, now
    @lanes.clear
    @socket&.close
    @socket = @context.socket(ZMQ::DEALER)
    @socket.identity = @name
    { ZMQ::LINGER => 2000, ZMQ::RCVTIMEO => 50 }.each { |option, ms| @socket.setsockopt(option, ms) }
    @socket.connect(@address)
  end

  def now = Process.clock_gettime(Process::CLOCK_MONOTONIC)
  def say(head, *frames) = @socket.send_strings([head.to_msgpack, *frames], ZMQ::DONTWAIT)

  def tick
    return leave(0, "asked to stop") if @stop
    return leave(1, "no learner answers at #{@address}") if now > @give_up_at
    return join if now > @heard_at + @silence_s
    @session ? beat : hello if now > @next_at
  end

  def hello
    say({ type: "Hello", protocol: 10, worker: @name, host: Socket.gethostname.encode("UTF-8"),
          pid: Process.pid, process_nonce: @nonce, software: "millrace.rb", attempt: @attempt })
    @next_at, @pause_s = now + @pause_s, [2 * @pause_s, 4].min
  end

  def take(head, *frames)
    @heard_at = now
    case [MessagePack.unpack(head, symbolize_keys: true), *frames]
    in [{ type: "Refuse", reason: }] then leave(2, reason, nil)
    in [["Drain", reason]] then leave(0, reason)
    in [["Welcome", session, ^@attempt, run]] if @session.nil? then welcome(session, run)
    in [["Rejoin", ^@session]] then join
    in [["HeartbeatReply", ^@session, number, received]] if number > @replies
      @replies = number
      @lanes.select! { |lane, _| received.any? { |entry| entry[0] == lane } }
    in [["Release", ^@session, lanes]]
      @lanes.reject! { |held, lane| lanes.any? { |n, last| held == n && lane.incarnation <= last } }
    in [["Reset", ^@session, ticket, lane, incarnation, copies, seeds, _], _]
      order(ticket, lane, incarnation) { |all| copies.zip(seeds) { |n, seed| all[n].reset(seed) } }
    in [["Step", ^@session, ticket, lane, incarnation, [["<i8", [n], 1]]], raw] if raw.bytesize == 8 * n
      order(ticket, lane, incarnation) do |all|
        all.zip(raw.unpack("q<*")) { |copy, action| copy.step(action) }
        @steps += n
      end
    in [["Call", ^@session, ticket, lane, incarnation, _, _, _, _], _]
      say(["Returned", @session, ticket, lane, incarnation, ["|u1", [0], 1], "no attributes", ""], "")
    else nil # of another session, of no use here, or with a field or a frame too many
    end
  rescue StandardError => e
    warn "#{@name}: cannot read a message: #{e.message}"
  end

  def leave(code, reason, last_words = ["Goodbye", @session, reason, []])
    say(last_words) if @session && last_words
    warn "#{@name}: #{reason}"
    @exit_code = code
  end

  def welcome(session, run)
    @session, @run, @replies, @next_at = session, run, 0, 0
    @silence_s = run.fetch(:learner_timeout_s) { run[:type] == "StepSpec" ? 600 : 30 }
    envs = (run[:envs] || [run[:env]]).map { |env| env.reject { |_, v| v.nil? || v.empty? } }
    return if run[:type] != "RunSpec" && envs == [{ id: @environment::ID }] && !run[:seats]&.any? &&
              (run[:autoreset] || "NextStep") == "NextStep"
    leave(2, "expected --inference learner, #{@environment::ID}; got #{run[:type]}, #{envs}, #{run[:seats]}"[0, 1000])
  end

  def beat
    say(["Heartbeat", @session, @replies, [], @held, @steps, {}, 0])
    describe if @run[:type] == "DescribeSpec"
    @next_at, @give_up_at = now + @run.fetch(:heartbeat_s, 1), now + 600
  end

  def describe
    box = ["BoxSpace", @environment::SHAPE, "float32", ["<f4", [], 1], ["<f4", [], 2]]
    discrete = ["DiscreteSpace", @environment::ACTIONS, 0, "int64"]
    say(["Described", @session, [box, discrete, ["|u1", [1], 3], "", @environment::TIME_LIMIT, ""]],
        [@environment::LOW].pack("e"), [@environment::HIGH].pack("e"), {}.to_msgpack)
  end

  Lane = Struct.new(:incarnation, :copies, :ticket)
  Copy = Struct.new(:env, :row) do # the row: observation, reward, terminated, truncated
    def reset(seed) = self.row = [env.reset(seed), 0, false, false]
    def step(action) = row && row.last(2).none? ? self.row = env.step(action) : reset(nil)
  end

  def order(ticket, number, incarnation)
    return unless [ticket, number, incarnation].all?(Integer) && @run[:lanes]&.at(number)
    lane = @lanes[number]
    lane = @lanes[number] = Lane.new(incarnation, nil, -1) if !lane || incarnation > lane.incarnation
    return if incarnation < lane.incarnation || ticket < lane.ticket # a late copy
    work(ticket) { yield lane.copies ||= open_copies(number) } if ticket > lane.ticket # only once
    lane.ticket = ticket
    answer([ticket, number, incarnation], lane.copies)
  rescue StandardError => e
    error, traceback = "lane #{number}: #{e.message.inspect}", [e.message, *e.backtrace].join("\n")
    leave(1, traceback, ["Failure", @session, error[0, 1000], traceback[0, 64_000], number])
  end

  def open_copies(number) = Array.new(@run[:lanes][number]) { Copy.new(@environment.new) }

  def work(ticket) # while the environment works, the thread of run sends heartbeats
    @held = [ticket]
    @lock.unlock
    yield
  ensure
    @lock.lock
    @held = []
  end

  def answer(order, copies)
    n, shape = copies.size, @environment::SHAPE
    none = [[0] * shape.reduce(1, :*), 0, false, false]
    obs, reward, *flags = copies.map { |copy| copy.row || none }.transpose
    say(["Stepped", @session, *order, [["<f4", [n, *shape], 1]], ["<f8", [n], 2],
         ["|b1", [n], 3], ["|b1", [n], 4], ["|u1", [0], 5]],
        obs.flatten.pack("e*"), reward.pack("E*"), *flags.map { |f| f.map { |v| v ? 1 : 0 }.pack("C*") }, "")
  end
end
